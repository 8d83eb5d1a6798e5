"""The live overview of a benchmark: what runs, how far it is, and how long it will take."""

import time

from rich.table import Table

from sb3_chdp.benchmark.results import ResultsError, Row
from sb3_chdp.benchmark.runs import Run


class Overview:
    """
    :param runs: all runs of the benchmark
    :param steps: environment steps of each
    """

    def __init__(self, runs: list[Run], steps: list[int]):
        self.runs = list(zip(runs, steps, strict=True))
        self.started = time.time()
        self.done_before = sum(self._progress(run, total)[0] for run, total in self.runs)
        self.failed: set[str] = set()

    def _progress(self, run: Run, total: int) -> tuple[float, Row]:
        """:return: environment steps so far, and the last evaluation"""
        try:
            rows = run.rows()
        except ResultsError:  # the run itself reports it
            rows = []
        last = rows[-1] if rows else {}
        return (total if run.is_complete else min(last.get("timesteps", 0.0), total)), last

    def table(self) -> Table:
        """:return: a line per run that has been worked on since the start, and the expected time to the end"""
        table = Table("algorithm", "environment", "seed", "progress", "success", "return", "minutes")
        done = 0.0
        for run, total in self.runs:
            steps, last = self._progress(run, total)
            done += steps
            failed = str(run.folder) in self.failed
            if failed or (run.csv.exists() and run.csv.stat().st_mtime > self.started):
                success = last.get("success", float("nan"))
                progress = "[red]failed" if failed else "done" if run.is_complete else f"{100 * steps / total:.0f} %"
                table.add_row(
                    run.name,
                    run.env_id,
                    str(run.seed),
                    progress,
                    f"{100 * success:.0f} %" if success == success else "",
                    f"{last['return']:.4g}" if last else "",
                    f"{last['seconds'] / 60:.1f}" if last else "",
                )
        work, elapsed = sum(total for _, total in self.runs), time.time() - self.started
        here = done - self.done_before
        remaining = f", {elapsed * (work - done) / here / 60:.0f} min left" if here > 0 else ""
        table.caption = f"{100 * done / work:.0f} % of {len(self.runs)} runs, {elapsed / 60:.0f} min{remaining}"
        return table
