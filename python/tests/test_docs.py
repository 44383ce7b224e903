"""The code in docs/PYTHON.md runs as it stands there, block after block."""
import doctest
import importlib.util
import pathlib
import re

import pytest

ROOT = pathlib.Path(__file__).parent.parent.parent
BLOCKS = re.findall(r"```python\n(.*?)```", (ROOT / "docs/PYTHON.md").read_text(), re.DOTALL)
NAMES: dict[str, object] = {}


def missing(code):
    """Returns the packages that code imports and that are not here."""
    names = {found.split(".")[0] for found in re.findall(r"^(?:from|import) ([\w.]+)", code, re.MULTILINE)}
    return sorted(name for name in names if importlib.util.find_spec(name) is None)


@pytest.mark.parametrize("number", range(len(BLOCKS)))
def test_the_code_of_the_document_runs(number, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code = BLOCKS[number]
    if missing(code):
        pytest.skip(f"not installed: {missing(code)}")
    if "program()" in code and not (pathlib.Path(__import__("shadow_repose").__file__).parent / "bin").is_dir():
        pytest.skip("this package is without the program")
    if ">>>" in code:
        test = doctest.DocTestParser().get_doctest(code, NAMES, f"block {number}", "docs/PYTHON.md", 0)
        assert doctest.DocTestRunner().run(test).failed == 0
    else:
        try:
            exec(compile(code, f"docs/PYTHON.md, block {number}", "exec"), NAMES)
        except RuntimeError as error:
            if "EGL" not in str(error):
                raise
            pytest.skip("pictures cannot be drawn here")


def test_there_is_code_in_the_document():
    assert len(BLOCKS) >= 5
