"""The command ``sb3-chdp`` in a process of its own, forked from one that has done the slow imports."""

import multiprocessing
import os
import sys
import tempfile
from pathlib import Path

import torch as th


def _main(arguments, cwd, output):
    with open(output, "w") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    th.set_num_threads(1)
    os.chdir(cwd)
    # As python -m does it
    sys.path.insert(0, str(cwd))
    sys.argv = ["sb3-chdp", *arguments]
    from sb3_chdp.cli import main

    main()


def run(*arguments, cwd, code=0):
    """
    :param arguments: those of ``sb3-chdp``
    :param cwd: the folder that it runs in
    :param code: the exit code that it must have
    :return: what it printed
    """
    with tempfile.TemporaryDirectory() as folder:
        output = Path(folder) / "output"
        process = multiprocessing.get_context("forkserver").Process(target=_main, args=(arguments, cwd, output))
        process.start()
        process.join(timeout=300)
        in_time = not process.is_alive()
        process.kill()
        text = output.read_text()
    assert in_time and process.exitcode == code, text
    return text
