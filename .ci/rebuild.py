"""Rebuild every table, figure and the report from the committed records, and compare byte for byte.

Records of a release are made from a clean commit: one that says otherwise is a problem, too.
"""

import json
import shutil
import sys
import tempfile
from pathlib import Path

from wbc_bench.publish import publish
from wbc_bench.results.report import GIVEN
from wbc_bench.results.store import ResultStore


def products(root: Path) -> dict[str, bytes]:
    """Path below `root` -> bytes of everything that is made from records."""
    paths = [*root.glob("tables/**/*"), *root.glob("figures/**/*"), *root.glob("report.html")]
    return {str(path.relative_to(root)): path.read_bytes() for path in paths if path.is_file()}


def dirty(root: Path) -> list[Path]:
    """The records below `root` that do not say that their commit was clean."""
    return [
        path
        for path in sorted(root.rglob("run.json"))
        if json.loads(path.read_text())["git_dirty"] is not False
    ]


def main() -> int:
    results = Path(sys.argv[1])
    store, committed = ResultStore(results), products(results)
    if not store.runs():
        print(f"SKIPPED: no records under {results} yet")
        return 1 if committed else 0  # tables without records are nobody's
    with tempfile.TemporaryDirectory() as folder:
        for path in sorted(path for pattern in GIVEN for path in results.glob(pattern) if path.is_file()):
            copy = Path(folder) / path.relative_to(results)
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, copy)
        for records in ("runs", "tracks", "doors", "stress"):  # as a report beside its records has them
            if (results / records).exists():
                (Path(folder) / records).symlink_to((results / records).resolve())
        publish(ResultStore(folder), Path(folder))
        rebuilt = products(Path(folder))
    problems = [f"not made by the records: {name}" for name in sorted(committed.keys() - rebuilt.keys())]
    problems += [f"not committed: {name}" for name in sorted(rebuilt.keys() - committed.keys())]
    both = sorted(rebuilt.keys() & committed.keys())
    problems += [f"differs: {name}" for name in both if rebuilt[name] != committed[name]]
    problems += [f"made from a dirty commit: {path}" for path in dirty(results)]
    print(*problems, f"{len(both)} files compared, {len(problems)} problems", sep="\n")
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
