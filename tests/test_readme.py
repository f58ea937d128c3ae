import re
from pathlib import Path

README = Path(__file__).parents[1] / "README.md"


def test_the_python_example_runs_as_it_stands(capsys):
    (code,) = re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL)
    exec(code, {})
    assert "Car 0.76, matched" in capsys.readouterr().out


def test_linked_pages_and_pictures_exist():
    targets = re.findall(r"\]\((docs/[^)]+)\)", README.read_text())
    assert len(targets) > 5
    assert [t for t in targets if not (README.parent / t).is_file()] == []
