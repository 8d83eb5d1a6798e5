"""Runs as jobs of submitit: processes of this machine, or jobs of Slurm."""

import os
import subprocess
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import submitit
from submitit.helpers import Checkpointable

from sb3_chdp.benchmark.runs import Run

# submitit wants a limit also where there is none
LOCAL_TIMEOUT_MIN = 60 * 24 * 365
SLURM_TIMEOUT_MIN = 60 * 24
CLUSTERS = ("local", "slurm")
SLURM_LOOK_INTERVAL = 10.0


def end_with(pid: int) -> None:
    """End this process soon after another one of this machine."""

    def watch() -> None:
        while True:
            time.sleep(1)
            try:
                os.kill(pid, 0)
            except ProcessLookupError:
                os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


class Job(Checkpointable):
    """
    What submitit runs. A job that Slurm preempts is queued again, and goes on from the run's last checkpoint.

    :param run: the run
    :param parent: process with which the job ends, None for a job that outlives the command
    """

    def __init__(self, run: Run, parent: int | None):
        self.run, self.parent = run, parent

    def __call__(self) -> str:
        # torch is imported by the jobs alone
        from sb3_chdp.benchmark.training import train

        if self.parent is not None:
            end_with(self.parent)
        return train(self.run)


def make_executor(cluster: str, folder: Path, threads: int, gpus: int, n_jobs: int | None, options: dict[str, Any]) -> Any:
    """
    :param cluster: ``local`` or ``slurm``
    :param folder: for the logs of the jobs
    :param threads: cores of a job
    :param gpus: GPUs of a job
    :param n_jobs: jobs at a time
    :param options: further parameters of submitit
    :return: submitit's executor
    """
    # Inherited by the jobs, whichever cluster: small networks are fastest on few threads
    os.environ["OMP_NUM_THREADS"] = str(threads)
    executor = submitit.AutoExecutor(folder / "%j", cluster=cluster)
    timeout = LOCAL_TIMEOUT_MIN if cluster == "local" else SLURM_TIMEOUT_MIN
    executor.update_parameters(name="benchmark", timeout_min=timeout, cpus_per_task=threads, gpus_per_node=gpus)
    if cluster == "slurm" and n_jobs is not None:
        executor.update_parameters(slurm_array_parallelism=n_jobs)
    executor.update_parameters(**options)
    return executor


class Queue:
    """
    Submit runs and collect what becomes of them.

    :param runs: the runs
    :param executor: submitit's executor
    :param cluster: ``local`` or ``slurm``
    :param n_jobs: jobs at a time, of a local cluster; Slurm keeps its own count
    """

    def __init__(self, runs: list[Run], executor: Any, cluster: str, n_jobs: int):
        self.waiting, self.executor, self.cluster = list(runs), executor, cluster
        self.n_jobs = n_jobs if cluster == "local" else len(runs)
        self.running: list[tuple[Run, submitit.Job[str]]] = []
        self.last_look = -SLURM_LOOK_INTERVAL
        self.absent: set[str] = set()
        self.gone: set[str] = set()

    def submit(self) -> None:
        """Submit as many runs as there is room for."""
        room = self.n_jobs - len(self.running)
        runs, self.waiting = self.waiting[:room], self.waiting[room:]
        if runs:
            parent = os.getpid() if self.cluster == "local" else None
            self.running += zip(runs, self.executor.submit_array([Job(run, parent) for run in runs]), strict=True)

    def collect(self) -> Iterator[tuple[Run, str, bool]]:
        """:return: run, a line about it, and whether it failed, for every job that has ended since the last call"""
        for run, job in self._ended():
            self.running.remove((run, job))
            try:
                if not job.paths.result_pickle.exists():
                    raise submitit.core.utils.UncompletedJobError
                yield run, job.result(), False
            except Exception as error:  # one run that fails must not cost the others
                yield run, f"{run.folder}: {reason(error)} (log: {job.paths.stderr})", True

    def _ended(self) -> list[tuple[Run, "submitit.Job[str]"]]:
        """:return: running jobs that run no more"""
        if self.cluster == "local":
            return [(run, job) for run, job in self.running if job.done()]
        # Not job.done(), which needs Slurm's accounting: without it nobody would see that a job was killed
        if time.monotonic() - self.last_look > SLURM_LOOK_INTERVAL:
            self.last_look, queued = time.monotonic(), slurm_jobs()
            if queued is not None:
                ids = {job.job_id for _, job in self.running}
                # Absent twice: a result takes a while to be seen on other machines
                self.gone, self.absent = self.absent & (ids - queued), ids - queued
        return [(run, job) for run, job in self.running if job.job_id in self.gone or job.paths.result_pickle.exists()]

    def cancel(self) -> None:
        """End local jobs; those of Slurm go on without this command."""
        if self.cluster == "local":
            for _, job in self.running:
                job.cancel()


def slurm_jobs() -> set[str] | None:
    """:return: ids of the jobs that Slurm has running or waiting, None if it does not answer"""
    answer = subprocess.run(["squeue", "--noheader", "--array", "--format=%i"], capture_output=True, text=True)
    return set(answer.stdout.split()) if answer.returncode == 0 else None


def reason(error: Exception) -> str:
    """:return: a line that says why a job failed"""
    errors = submitit.core.utils
    if isinstance(error, errors.UncompletedJobError) and not isinstance(error, errors.FailedJobError):
        return "its process was killed, perhaps for want of memory"
    # The exception at the end of the traceback that submitit quotes
    quoted = str(error).split("----------------------")
    lines = [line.strip() for line in quoted[1 if len(quoted) > 2 else 0].splitlines() if line.strip()]
    return lines[-1] if lines else repr(error)
