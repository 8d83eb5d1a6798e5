"""Functions and the command ``sb3-chdp`` in processes of their own, forked from one that has done the slow imports."""

import multiprocessing
import os
import sys
import tempfile
from pathlib import Path

import torch as th


def _call(function, arguments, cwd, output):
    with open(output, "w") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    th.set_num_threads(1)
    os.chdir(cwd)
    # As python -m does it
    sys.path.insert(0, str(cwd))
    function(*arguments)


def start(function, *arguments, cwd, output=os.devnull):
    """
    :param function: one that can be imported
    :param arguments: its arguments
    :param cwd: the folder that it runs in
    :param output: where to write what it prints
    :return: the process; it is left to the caller to end it
    """
    process = multiprocessing.get_context("forkserver").Process(target=_call, args=(function, arguments, cwd, output))
    process.start()
    return process


def main(*arguments):
    """The command ``sb3-chdp``."""
    from sb3_chdp import cli

    sys.argv = ["sb3-chdp", *arguments]
    cli.main()


def run(*arguments, cwd, code=0, main=main):
    """
    :param arguments: those of ``sb3-chdp``
    :param cwd: the folder that it runs in
    :param code: the exit code that it must have
    :param main: what to call with the arguments
    :return: what it printed
    """
    with tempfile.TemporaryDirectory() as folder:
        output = Path(folder) / "output"
        process = start(main, *arguments, cwd=cwd, output=output)
        process.join(timeout=300)
        in_time = not process.is_alive()
        process.kill()
        text = output.read_text()
    assert in_time and process.exitcode == code, text
    return text
