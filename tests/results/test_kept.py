"""Parts of a report that follow from the same records and code are taken from the last one."""

import json
import shutil
from pathlib import Path

import pytest

from wbc_bench.publish import publish
from wbc_bench.results.figures import style
from wbc_bench.results.kept import NOTE, KeptParts
from wbc_bench.results.store import ResultStore

RECORDS = Path(__file__).parents[2] / "results"
FIGURE = "figures/figure.svg"


class Maker:
    """Counts how often it makes its file."""

    def __init__(self) -> None:
        self.calls = 0

    def __call__(self, folder: Path) -> None:
        self.calls += 1
        (folder / "figures").mkdir(exist_ok=True)
        (folder / FIGURE).write_text("drawn")


def report(out: Path, made: Path, maker: Maker, inputs: object = "same") -> None:
    """Make a report of one part in `made` and move it to `out`."""
    made.mkdir()
    kept = KeptParts(out, made, "wbc_bench.publish")
    kept.part("part", inputs, maker)
    kept.write()
    shutil.copytree(made, out, dirs_exist_ok=True)
    shutil.rmtree(made)


def test_a_part_is_made_again_only_when_its_inputs_or_files_change(tmp_path):
    out, made, maker = tmp_path / "out", tmp_path / "made", Maker()
    for inputs, calls in (("same", 1), ("same", 1), (("other", 2.0), 2), (("other", 2.0), 2)):
        report(out, made, maker, inputs)
        assert maker.calls == calls and (out / FIGURE).read_text() == "drawn"
    (out / FIGURE).write_text("by hand")
    report(out, made, maker, ("other", 2.0))
    assert maker.calls == 3 and (out / FIGURE).read_text() == "drawn"
    (out / FIGURE).unlink()
    report(out, made, maker, ("other", 2.0))
    assert maker.calls == 4 and (out / FIGURE).read_text() == "drawn"


def test_other_code_keeps_nothing(tmp_path, monkeypatch):
    out, made, maker = tmp_path / "out", tmp_path / "made", Maker()
    report(out, made, maker)
    monkeypatch.setattr("wbc_bench.provenance.versions", lambda: {"matplotlib": "another"})
    report(out, made, maker)
    assert maker.calls == 2


@pytest.mark.parametrize("note", [b"", b"\xff", b"[1]", b'{"part": {"inputs": 1}}', b'{"part": {}}'])
def test_a_damaged_note_keeps_nothing(tmp_path, note):
    out, made, maker = tmp_path / "out", tmp_path / "made", Maker()
    report(out, made, maker)
    (out / NOTE).write_bytes(note)
    report(out, made, maker)
    assert maker.calls == 2


def test_a_note_names_no_file_outside_the_report(tmp_path):
    out, made, maker = tmp_path / "out", tmp_path / "made", Maker()
    report(out, made, maker)
    note = json.loads((out / NOTE).read_text())
    [digest] = note["part"]["files"].values()
    (tmp_path / "figure.svg").write_text("drawn")
    for path in ("../figure.svg", str(tmp_path / "figure.svg")):
        note["part"]["files"] = {path: digest}
        (out / NOTE).write_text(json.dumps(note))
        calls = maker.calls
        report(out, made, maker)
        assert maker.calls == calls + 1


def test_a_report_draws_only_the_protocol_that_got_a_row(tmp_path, monkeypatch):
    def records(protocol: str, controller: str) -> None:
        shutil.copytree(RECORDS / "runs" / protocol / controller, tmp_path / "runs" / protocol / controller)

    drawn: list[str] = []
    save = style.FigureCanvasSVG.print_svg
    monkeypatch.setattr(
        style.FigureCanvasSVG,
        "print_svg",
        lambda canvas, path, **more: (drawn.append(Path(path).name), save(canvas, path, **more)),
    )
    for protocol in ("ablation_v2", "nominal_v2"):
        records(protocol, "ik")
    publish(ResultStore(tmp_path), tmp_path)
    first = {path: path.read_bytes() for path in tmp_path.glob("figures/*")}
    assert len(drawn) == len(set(drawn)) == len(first) / 2
    drawn.clear()
    publish(ResultStore(tmp_path), tmp_path)
    assert drawn == []
    assert {path: path.read_bytes() for path in tmp_path.glob("figures/*")} == first
    records("nominal_v2", "hold")
    publish(ResultStore(tmp_path), tmp_path)
    assert drawn and all(name.startswith("nominal_v2") for name in drawn)
    publish(ResultStore(tmp_path), tmp_path / "elsewhere")  # made there from nothing
    elsewhere = tmp_path / "elsewhere"
    for path in tmp_path.glob("figures/*"):
        assert (elsewhere / "figures" / path.name).read_bytes() == path.read_bytes()
