"""Figures of the source tree: sizes by room, import circles, hidden imports, threads, ambiguous names, tests.

    python benchmarks/house.py --json docs/results/house.json
    python benchmarks/house.py --tests ...    # also run `make test` and time it, on an idle machine

The source is parsed, never imported; walk.py runs Generate and counts the files that it passes. The items counted are
printed above the figures.
"""

from __future__ import annotations

import ast
import json
import re
import subprocess
import sys
import tempfile
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import record

ROOT = Path(__file__).resolve().parents[1]
PROGRAMS = {"backend": ROOT / "backend" / "primdiffusion", "extension": ROOT / "blender_primdiffusion"}
TESTS = {"backend": ROOT / "tests" / "backend", "extension": ROOT / "tests" / "blender"}
"""tests/contract tests both programs together, so it mirrors neither."""
BLENDERS = ("5.0", "5.2", "5.3")
THREAD_MODULES = {"threading", "_thread", "concurrent.futures", "multiprocessing"}
COLOURS = re.compile(r"(rgba?|image|img|combined|target): .*\b([hH]\w* [wW]\w* [34]|side side 4)\b|rgb: .*'\*r 3'")
FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)


@dataclass(frozen=True)
class Import:
    targets: tuple[str, ...]
    """Dotted names; `from a import b` gives a.b, which may be a module or a name defined in a."""
    first_line: int
    in_function: bool


@dataclass(frozen=True)
class Module:
    """A parsed file of the product."""

    program: str
    path: Path
    name: str
    """Dotted."""
    source: str
    imports: tuple[Import, ...]
    classes: frozenset[str]

    @property
    def room(self) -> str:
        """The package below the program's own, "top" for files directly in it."""
        parts = self.path.relative_to(PROGRAMS[self.program]).parts
        return parts[0] if len(parts) > 1 else "top"

    @property
    def lines(self) -> int:
        """Lines of the file, including blank lines and comments."""
        return len(self.source.splitlines())


def main() -> None:
    parser = record.command_line(__doc__)
    parser.add_argument("--tests", action="store_true", help="time the tests on each Blender; all must pass")
    arguments = parser.parse_args()
    modules = parsed()
    findings = {
        "import_circles": import_circles(modules),
        "hidden_imports": hidden_imports(modules),
        "threads_in_extension": threads_in_extension(modules),
        "names_with_two_meanings": names_with_two_meanings(modules),
        "picture_records": picture_records(modules),
        "tests_without_source": tests_without_source(),
    }
    for name, found in findings.items():
        print(f"{name}:", *(found or ["none"]), sep="\n  ", end="\n\n")
    figures: dict[str, float | None] = {**sizes(modules), **{name: len(found) for name, found in findings.items()}}
    figures |= test_sizes() | (test_minutes() if arguments.tests else {"test_minutes": None})
    figures |= walk()
    record.report(figures, arguments.json)


def parsed() -> list[Module]:
    """All Python files of both programs."""
    modules = []
    for program, folder in PROGRAMS.items():
        for path in sorted(folder.rglob("*.py")):
            source = path.read_text(encoding="utf-8")
            parts = path.relative_to(folder.parent).with_suffix("").parts
            is_package = parts[-1] == "__init__"
            name = ".".join(parts[:-1] if is_package else parts)
            tree = ast.parse(source, str(path))
            package = name if is_package else name.rpartition(".")[0]
            classes = frozenset(node.name for node in ast.walk(tree) if isinstance(node, ast.ClassDef))
            modules.append(Module(program, path, name, source, tuple(_imports(tree, package)), classes))
    return modules


def sizes(modules: list[Module]) -> dict[str, float | None]:
    """Lines and files of the product, of each program and of each room."""
    lines: dict[str, float | None] = defaultdict(int)
    files: dict[str, float | None] = defaultdict(int)
    for module in modules:
        for part in ("product", module.program, f"{module.program}_{module.room}"):
            lines[f"{part}_lines"] += module.lines
            files[f"{part}_files"] += 1
    by_part: dict[str, float | None] = {}
    for name in sorted(lines, key=lambda name: (name != "product_lines", name)):
        count = name.replace("_lines", "_files")
        by_part |= {name: lines[name], count: files[count]}
    return by_part


def import_circles(modules: list[Module]) -> list[str]:
    """Groups of modules that import each other: at module level, in functions, by `importlib`, for type checking.

    Parent packages that an import loads on its way to a module are not counted.
    """
    names = {module.name for module in modules}
    graph: dict[str, set[str]] = {}
    for module in modules:
        targets = (target for each in module.imports for target in each.targets)
        known = (target if target in names else target.rpartition(".")[0] for target in targets)
        graph[module.name] = {target for target in known if target in names} - {module.name}
    return [" <-> ".join(sorted(group)) for group in _circles(graph)]


def hidden_imports(modules: list[Module]) -> list[str]:
    """Imports in functions, whatever a comment says of them; `importlib.import_module` counts too."""
    return [
        f"{module.path.relative_to(ROOT)}:{each.first_line} {', '.join(each.targets)}"
        for module in modules
        for each in sorted(module.imports, key=lambda each: each.first_line)
        if each.in_function
    ]


def threads_in_extension(modules: list[Module]) -> list[str]:
    """Files of the extension that import a module of threads or processes."""
    return [
        str(module.path.relative_to(ROOT))
        for module in modules
        if module.program == "extension"
        and any(
            target == name or target.startswith(f"{name}.")
            for each in module.imports
            for target in each.targets
            for name in THREAD_MODULES
        )
    ]


def names_with_two_meanings(modules: list[Module]) -> list[str]:
    """Public names of classes that two or more modules define."""
    homes: dict[str, list[str]] = defaultdict(list)
    for module in modules:
        for name in module.classes:
            if not name.startswith("_"):
                homes[name].append(module.name)
    return [f"{name}: {', '.join(where)}" for name, where in sorted(homes.items()) if len(where) > 1]


def picture_records(modules: list[Module]) -> list[str]:
    """Public classes of the backend with a field of an image's colours: [rows, columns, 3 or 4], or [*r, 3]."""
    return [
        f"{module.name}.{node.name}"
        for module in modules
        if module.program == "backend"
        for node in ast.walk(ast.parse(module.source))
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_")
        if any(isinstance(line, ast.AnnAssign) and COLOURS.match(ast.unparse(line)) for line in node.body)
    ]


def tests_without_source() -> list[str]:
    """Test files whose path names no source file or package.

    `render/test_march.py` is the test of `render/march.py`, `render/test_march_gradients.py` of one aspect of it.
    """
    found = []
    for program, folder in TESTS.items():
        for path in sorted(folder.rglob("test_*.py")):
            words = path.stem.split("_")[1:]
            beside = PROGRAMS[program] / path.parent.relative_to(folder)
            names = ["_".join(words[:count]) for count in range(len(words), 0, -1)]
            if not any((beside / f"{name}.py").is_file() or (beside / name).is_dir() for name in names):
                found.append(str(path.relative_to(ROOT)))
    return found


def test_sizes() -> dict[str, float | None]:
    """Lines and files of the tests with their helpers, and how many of them match an error's words."""
    sources = [path.read_text(encoding="utf-8") for path in (ROOT / "tests").rglob("*.py")]
    return {
        "test_lines": sum(len(source.splitlines()) for source in sources),
        "test_files": len(sources),
        "match_in_tests": sum(source.count("match=") for source in sources),
    }


def test_minutes() -> dict[str, float | None]:
    """Minutes of the tests on each Blender and in all; ends with an error if a test fails."""
    figures: dict[str, float | None] = {}
    for blender in BLENDERS:
        with record.measured() as took:
            subprocess.run(["make", f"test-{blender}"], cwd=ROOT, check=True)
        figures[f"test_minutes_{blender.replace('.', '_')}"] = took.seconds / 60
    return {"test_minutes": sum(filter(None, figures.values())), **figures}


def walk() -> Mapping[str, float | None]:
    """Run walk.py in its own process and read its figures."""
    with tempfile.TemporaryDirectory(prefix="primdiffusion_house_") as folder:
        path = Path(folder) / "walk.json"
        subprocess.run([sys.executable, str(ROOT / "benchmarks" / "walk.py"), "--json", str(path)], check=True)
        figures = json.loads(path.read_text(encoding="utf-8"))
    return {name: figures[name] for name in ("walk_extension_files", "walk_backend_files", "open_walk_files")}


def _imports(tree: ast.AST, package: str, in_function: bool = False) -> Iterator[Import]:
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            yield Import(tuple(_targets(node, package)), node.lineno, in_function)
            continue
        if isinstance(node, ast.Call) and ast.unparse(node.func).endswith("import_module"):
            name = node.args[0]
            target = name.value if isinstance(name, ast.Constant) else ast.unparse(name)
            yield Import((str(target),), node.lineno, in_function)
        yield from _imports(node, package, in_function or isinstance(node, FUNCTIONS))


def _targets(node: ast.Import | ast.ImportFrom, package: str) -> Iterator[str]:
    if isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names)
        return
    parents = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
    origin = ".".join([*parents, *([node.module] if node.module else [])])
    yield from (f"{origin}.{alias.name}" for alias in node.names)


def _circles(graph: Mapping[str, set[str]]) -> list[set[str]]:
    """Strongly connected components of two or more (Tarjan 1972)."""
    order: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    circles: list[set[str]] = []

    def visit(node: str) -> None:
        order[node] = low[node] = len(order)
        stack.append(node)
        for target in sorted(graph[node]):
            if target not in order:
                visit(target)
                low[node] = min(low[node], low[target])
            elif target in stack:
                low[node] = min(low[node], order[target])
        if low[node] == order[node]:
            start = stack.index(node)
            if len(stack) - start > 1:
                circles.append(set(stack[start:]))
            del stack[start:]

    for node in sorted(graph):
        if node not in order:
            visit(node)
    return circles


if __name__ == "__main__":
    main()
