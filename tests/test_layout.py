"""The order of the floors: imports go down this list and never back up, and there is no circle."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import lcf3d

ROOT = Path(lcf3d.__file__).parent
FLOORS = (
    ("errors",),
    (
        "distortion",
        "converters",
        "structures",
        "frame",
        "files",
        "reasons",
        "provenance",
        "decisions",
        "plugins",
        "processes",
        "kernels",
        "remote",
    ),
    ("geometry",),
    ("networks",),
    ("fusion",),
    ("detectors",),
    ("formats",),
    ("visualization",),
    ("localizers",),
    ("datasets",),
    ("run",),
    ("live",),
    ("evaluation",),
    ("simulation",),
    ("benchmark",),
    ("paper",),
    ("demo",),
    ("training",),
    ("cli",),
)
FLOOR_OF = {name: floor for floor, names in enumerate(FLOORS) for name in names}


def imports(path: Path) -> Iterator[str]:
    """Modules that a file imports, wherever in it: ``from a import b`` counts as ``a.b`` where that is a module."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            for alias in node.names:
                inner = ROOT.joinpath(*str(node.module).split(".")[1:], alias.name)
                is_module = inner.with_suffix(".py").is_file() or inner.is_dir()
                yield f"{node.module}.{alias.name}" if is_module else str(node.module)


def arrows() -> list[tuple[str, str]]:
    """(importing module, imported module) for all imports inside the package, but for those of its face."""
    pairs = []
    for path in sorted(ROOT.rglob("*.py")):
        module = ".".join(("lcf3d", *path.relative_to(ROOT).with_suffix("").parts)).removesuffix(".__init__")
        if module in ("lcf3d", "lcf3d.__main__", "lcf3d.api"):
            continue
        pairs += [(module, name) for name in imports(path) if name.startswith("lcf3d.")]
    return pairs


def test_no_import_goes_up() -> None:
    wrong = []
    for module, imported in arrows():
        here, there = module.split(".")[1], imported.split(".")[1]
        if FLOOR_OF[there] > FLOOR_OF[here]:
            wrong.append(f"{module} -> {imported}")
    assert not wrong, "\n".join(wrong)


def test_no_circle() -> None:
    graph: dict[str, set[str]] = {}
    for module, imported in arrows():
        graph.setdefault(module, set()).add(imported)
    done: set[str] = set()

    def visit(module: str, way: tuple[str, ...]) -> None:
        assert module not in way, " -> ".join((*way[way.index(module) :], module))
        if module not in done:
            for imported in sorted(graph.get(module, ())):
                visit(imported, (*way, module))
            done.add(module)

    for module in sorted(graph):
        visit(module, ())


def test_torch_and_onnxruntime_are_imported_in_one_place() -> None:
    wrong = [
        f"{path.relative_to(ROOT)} imports {name}"
        for path in sorted(ROOT.rglob("*.py"))
        if path.relative_to(ROOT).parts[0] != "networks"
        for name in imports(path)
        if name.split(".")[0] in ("torch", "torchvision", "onnxruntime")
    ]
    assert not wrong, "\n".join(wrong)


def test_studies_do_not_import_the_command_line() -> None:
    # but for the one that writes the command line's own tables of options
    studies = set((Path(__file__).parents[1] / "benchmarks").rglob("*.py"))
    studies -= {path for path in studies if path.name == "option_tables.py"}
    assert not [str(path) for path in studies if any(n.startswith("lcf3d.cli") for n in imports(path))]
