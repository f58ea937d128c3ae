import re
from pathlib import Path

PAGE = Path(__file__).parents[2] / "docs" / "live.md"


def test_the_example_runs_as_it_stands(capsys):
    (code,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    exec(code, {})
    printed = capsys.readouterr().out
    assert printed.startswith("10.0 car 0.8")
    assert printed.count("matched") == 1
