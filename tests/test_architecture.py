"""Imports point down only: every import statement of the two packages is read, the lazy ones too."""

import ast
import re
import subprocess
import sys
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGES = {"wbc_bench": ROOT / "wbc_bench", "wbc_baselines": ROOT / "baselines" / "wbc_baselines"}

# Top first: what stands below never imports what stands above; neighbours in a line do not know each other.
LAYERS = (
    ("__main__",),
    ("cli",),
    ("board",),
    ("publish", "viewer"),
    ("evaluation",),
    ("policies", "remote"),
    ("registry", "episode_function"),
    ("sources",),
    ("controller",),
    ("episodes",),
    ("robot", "results", "tensors"),
    ("provenance",),
    (
        "progress",
        "outcomes",
        "files",
        "readers",
        "schema",
        "installed",
        "isolation",
        "parallel",
    ),
    ("rotations", "randomness", "errors"),
)
HEAVY = ("mujoco", "torch", "pinocchio", "placo")


def module_name(path: Path) -> str:
    package = next(name for name, folder in PACKAGES.items() if path.is_relative_to(folder))
    parts = path.relative_to(PACKAGES[package]).with_suffix("").parts
    return ".".join([package, *parts]).removesuffix(".__init__")


MODULES = {module_name(path): path for folder in PACKAGES.values() for path in sorted(folder.rglob("*.py"))}


@cache
def imports(module: str) -> dict[str, set[str]]:
    """Imported module -> names taken from it (empty for `import x`), wherever the statement stands."""
    found: dict[str, set[str]] = {}
    for node in ast.walk(ast.parse(MODULES[module].read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            for alias in node.names:
                found.setdefault(alias.name, set())
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module}: relative imports hide what is imported"
            for alias in node.names:
                whole = f"{node.module}.{alias.name}"
                if whole in MODULES:
                    found.setdefault(whole, set())
                else:
                    found.setdefault(node.module or "", set()).add(alias.name)
    return found


@cache
def reaches(module: str) -> frozenset[str]:
    """Every module of the two packages, and every outside package, that an import of this one can lead to."""
    seen: set[str] = set()
    queue = [module]
    while queue:
        for name in imports(queue.pop()):
            if name not in seen:
                seen.add(name if name in MODULES else name.partition(".")[0])
                if name in MODULES:
                    queue.append(name)
    return frozenset(seen)


def group(module: str) -> str:
    """The part of a package that a module belongs to: `robot` for wbc_bench.robot.mjcf."""
    return module.split(".")[1] if "." in module else ""


def test_the_harness_knows_no_controller():
    for module in MODULES:
        if module.startswith("wbc_bench"):
            assert not any(name.startswith("wbc_baselines") for name in imports(module)), module


def test_baselines_use_public_names_only():
    for module in MODULES:
        if not module.startswith("wbc_baselines"):
            continue
        for name, taken in imports(module).items():
            if name.startswith("wbc_bench"):
                private = {part for part in (*name.split("."), *taken) if part.startswith("_")}
                assert not private, f"{module} takes {private} from {name}"


def test_baselines_do_not_know_each_other():
    for module in MODULES:
        if module.startswith("wbc_baselines.ik"):
            assert not any(name.startswith("wbc_baselines.learned") for name in reaches(module)), module
        if module.startswith("wbc_baselines.learned"):
            assert not any(name.startswith("wbc_baselines.ik") for name in reaches(module)), module


def test_every_part_of_the_harness_has_a_layer():
    parts = {group(module) for module in MODULES if module.startswith("wbc_bench.")}
    listed = [part for layer in LAYERS for part in layer]
    assert sorted(listed) == sorted(set(listed)) and parts == set(listed)


def test_imports_point_down():
    level = {part: k for k, layer in enumerate(LAYERS) for part in layer}
    for module in (m for m in MODULES if m.startswith("wbc_bench.")):
        for name in (n for n in imports(module) if n.startswith("wbc_bench.") and group(n) != group(module)):
            assert level[group(module)] < level[group(name)], f"{module} imports {name}"


def test_no_cycles():
    """No two files lead to each other, inside a part of a package as little as between its parts."""
    for module in MODULES:
        for name in imports(module):
            if name in MODULES:
                assert module not in reaches(name), f"{module} and {name} import each other"


def test_results_need_neither_physics_nor_learning():
    """Numbers are made of records alone: an analysis runs where neither is installed."""
    for module in (m for m in MODULES if m.startswith("wbc_bench.results")):
        assert not reaches(module) & set(HEAVY), module


def test_processes_are_started_in_one_place():
    """`wbc_bench.parallel` sees to it that none outlives its parent."""
    found = [module for module in MODULES if any(name.split(".")[0] == "joblib" for name in imports(module))]
    assert found == ["wbc_bench.parallel"]


def test_every_module_is_short_and_says_what_it_is_for():
    for module, path in MODULES.items():
        text = path.read_text(encoding="utf-8")
        assert len(text.splitlines()) <= 400, module
        assert path.name == "__init__.py" or ast.get_docstring(ast.parse(text)), module


def test_docstrings_hold_no_markup():
    """A bare `<name>` is a tag of HTML where the reference is rendered, and is not shown."""
    for module, path in MODULES.items():
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
                lines = (ast.get_docstring(node) or "").splitlines()
                text = "\n".join(line for line in lines if not line.startswith("    "))  # code otherwise
                tags = re.findall(r"</?[a-z_]+ ?/?>", re.sub(r"`[^`]*`", "", text))
                assert not tags, f"{module}, {getattr(node, 'name', 'module')}: {tags}"


def test_the_command_line_starts_light():
    """`wbc-bench --help` must not wait for numpy, let alone MuJoCo."""
    heavy = (*HEAVY, "numpy", "pandas", "scipy", "matplotlib", "joblib", "sklearn")
    code = f"import sys, wbc_bench.cli.main; print(*(m for m in {heavy} if m in sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""
