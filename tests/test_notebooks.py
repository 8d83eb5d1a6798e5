"""The cells of the notebooks run, with short trainings; `make notebooks` runs them as they are."""

import re
from pathlib import Path

import pytest

nbformat = pytest.importorskip("nbformat")
nbclient = pytest.importorskip("nbclient")

NOTEBOOKS = Path(__file__).parent.parent / "notebooks"
BUDGET = re.compile(r"(?<=\.learn\()[\d_]+(?=\))|(?<=--steps )\d+")


@pytest.mark.slow
@pytest.mark.parametrize("path", sorted(NOTEBOOKS.glob("*.ipynb")), ids=lambda path: path.stem)
def test_cells_run(path, tmp_path):
    notebook = nbformat.read(path, as_version=4)
    n_trainings = 0
    for cell in notebook.cells:
        if cell.cell_type == "code":
            cell.source, n = BUDGET.subn("120", cell.source)
            n_trainings += n
    assert n_trainings > 0
    nbclient.NotebookClient(notebook, timeout=600, resources={"metadata": {"path": str(tmp_path)}}).execute()
