"""The notebook in examples/ runs from top to bottom, and is stored as it was before its first run."""
import json
import os
import pathlib
import re
import sys

import pytest

import shadow_repose

EXAMPLES = pathlib.Path(__file__).parent.parent.parent / "examples"
NOTEBOOK = EXAMPLES / "first-look.ipynb"
CELLS = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]


def printed(cell):
    """Returns what a cell has printed, without the messages of the program."""
    return "".join(output["text"] for output in cell.outputs if output.output_type == "stream" and output.name == "stdout")


def shown(cell, kind):
    """Returns what a cell shows of one MIME type."""
    return "".join(output.data.get(kind, "") for output in cell.outputs if "data" in output)


def test_the_notebook_runs(tmp_path, monkeypatch):
    nbformat, nbclient = pytest.importorskip("nbformat"), pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    try:
        shadow_repose.program()
    except FileNotFoundError as error:
        pytest.skip(str(error))
    # The kernel finds the packages that this process finds. It ignores kernels and settings of the user who runs the test.
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, sys.path)))
    for place in ("IPYTHONDIR", "JUPYTER_CONFIG_DIR", "JUPYTER_DATA_DIR", "JUPYTER_RUNTIME_DIR", "TMPDIR"):
        folder = tmp_path / place
        folder.mkdir()
        monkeypatch.setenv(place, str(folder))
    work = tmp_path / "work"
    work.mkdir()
    notebook = nbformat.read(NOTEBOOK, 4)
    nbformat.validate(notebook)
    nbclient.NotebookClient(notebook, kernel_name="python3", timeout=300, resources={"metadata": {"path": str(work)}}).execute()
    cells = {cell.id: cell for cell in notebook.cells if cell.cell_type == "code"}
    assert float(re.search(r"goals per episode +(\S+)", printed(cells["score"])).group(1)) > 5
    assert "<polyline" in shown(cells["plot"], "image/svg+xml") and "<iframe srcdoc=" in shown(cells["replay"], "text/html")
    difference = re.search(r"differ by (\S+) at most", printed(cells["step"]))
    assert float(difference.group(1)) < 1e-5 if difference else "onnxruntime is not installed" in printed(cells["step"])
    random, learning = (float(re.findall(r"-?\d+\.\d+", line)[-1]) for line in printed(cells["learner"]).splitlines())
    assert learning > random + 0.1
    assert not any("Warning" in output.get("text", "") for cell in cells.values() for output in cell.outputs)
    assert not list(work.iterdir()), "all files go to a temporary folder"
    assert not list((tmp_path / "TMPDIR").glob("first-look-*")), "which is gone with the kernel"


def test_the_notebook_is_stored_without_outputs():
    code = [cell for cell in CELLS if cell["cell_type"] == "code"]
    assert len(code) > 5 and all(cell["outputs"] == [] and cell["execution_count"] is None for cell in code)


def test_links_of_the_notebook_lead_to_files_and_none_to_an_address():
    text = "".join("".join(cell["source"]) for cell in CELLS)
    links = re.findall(r"\]\(([^)]*)\)", text)
    assert len(links) > 3 and all((EXAMPLES / link).is_file() for link in links)
    assert "://" not in text and not re.search(r"""["'(](/|~/)""", text)
