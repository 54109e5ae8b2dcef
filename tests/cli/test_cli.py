"""The command line: every mistake is one line and exit code 2, and the commands do what they say."""

import json
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from importlib import metadata
from pathlib import Path

import pytest

from commands import fails
from tiny_protocol import write_tiny
from user_controllers import write_controller
from wbc_bench.cli.main import main
from wbc_bench.episodes.manifest import manifest_path
from wbc_bench.episodes.protocol import read_protocol


@pytest.fixture
def tiny(tmp_path) -> Path:
    return write_tiny(tmp_path)


def evaluate(protocol: Path, out: Path, *more: object, controller: str = "hold") -> None:
    words = ["eval", "--controller", controller, "--protocol", protocol, "--out", out, "--workers", 1, *more]
    main([str(word) for word in words])


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("no_such_module:made", "ModuleNotFoundError"),
        ("math:no_such_attribute", "AttributeError"),
        ("math:pi", "TypeError"),
        ("builtins:dict", "TypeError"),  # what it returns is no table
    ],
)
def test_benchmarks_and_inputs_of_others_fail_in_one_line(capsys, monkeypatch, value, message):
    def points(group):
        return [metadata.EntryPoint("broken", value, group)]

    monkeypatch.setattr(metadata, "entry_points", points)
    line = fails(capsys, "bench", "broken")
    assert "benchmark 'broken' failed" in line and message in line
    main(["list", "--inputs"])
    shown = capsys.readouterr().out
    assert "Inputs of broken" in shown and (value == "builtins:dict" or "cannot be listed" in shown)


def test_unknown_controller_names_the_nearest(capsys, tiny, tmp_path):
    line = fails(capsys, "eval", "--controller", "hodl", "--protocol", tiny, "--out", tmp_path / "out")
    assert "unknown controller 'hodl'" in line and "did you mean hold?" in line
    assert not (tmp_path / "out").exists()


def test_unknown_protocol_names_the_nearest(capsys):
    line = fails(capsys, "eval", "--controller", "hold", "--protocol", "smoke_v2")
    assert "unknown protocol 'smoke_v2'" in line and "smoke_v1" in line


@pytest.mark.parametrize(
    ("old", "new", "where"),
    [
        ("[noise]", "[noise]\njoint_speed = 1.0", "$.noise"),
        ("replicates = 2", 'replicates = "two"', "$.episodes.replicates"),
        ("height = [0.0, 1.0]", "height = [1.0, 0.0]", "$.targets.height"),
        ("replicates = 2", "replicates = 0", "$.episodes.replicates"),
        ("window = 0.1", "window = 9.0", "$.success.window"),
    ],
    ids=["unknown key", "wrong type", "reversed range", "zero count", "window beyond the horizon"],
)
def test_bad_protocol_names_the_field(capsys, tiny, old, new, where):
    text = tiny.read_text()
    assert old in text
    tiny.write_text(text.replace(old, new))
    line = fails(capsys, "eval", "--controller", "hold", "--protocol", tiny)
    assert where in line and tiny.name in line


def test_altered_manifest(capsys, tiny):
    path = manifest_path(tiny)
    data = bytearray(path.read_bytes())
    data[100] ^= 1
    path.write_bytes(data)
    assert "does not match its hash" in fails(capsys, "eval", "--controller", "hold", "--protocol", tiny)


def hint(line: str) -> list[str]:
    """The words of the command that a message gives in backticks, without the program."""
    (command,) = re.findall("`([^`]*)`", line)
    return shlex.split(command)[1:]


def test_the_commands_after_an_evaluation_without_a_manifest_work(capsys, tmp_path):
    """In a folder and under names that a shell would split."""
    folder = tmp_path / "my protocols"
    folder.mkdir()
    path = write_tiny(folder, replicates=1, episodes=2).rename(folder / "another name.toml")
    (folder / "tiny.parquet").unlink()
    line = fails(capsys, "eval", "--controller", "hold", "--protocol", path)
    assert "does not exist" in line
    main(hint(line))
    capsys.readouterr()
    evaluate(path, folder / "out")
    told = capsys.readouterr().out
    main(hint(told.splitlines()[-1]))
    assert (folder / "out" / "report.html").exists()
    capsys.readouterr()
    path.write_text(path.read_text().replace("horizon = 0.2", "horizon = 0.3"))
    line = fails(capsys, "eval", "--controller", "hold", "--protocol", path)
    main(hint(line))
    evaluate(path, folder / "other")


def test_the_manifest_of_a_released_protocol_is_made_by_its_name(tmp_path, monkeypatch):
    from wbc_bench.episodes import manifest
    from wbc_bench.errors import ManifestError

    monkeypatch.setattr(manifest, "PROTOCOLS", tmp_path)
    path = write_tiny(tmp_path)
    manifest_path(path).unlink()
    with pytest.raises(ManifestError) as error:
        manifest.read_manifest(read_protocol(path), manifest_path(path))
    assert hint(str(error.value)) == ["protocol", "freeze", "tiny"]


def test_manifest_of_another_protocol(capsys, tiny):
    tiny.write_text(tiny.read_text().replace("horizon = 0.2", "horizon = 0.3"))
    assert "protocol digest" in fails(capsys, "eval", "--controller", "hold", "--protocol", tiny)


@pytest.mark.parametrize(
    ("option", "value", "valid"),
    [
        ("--seeds", 0, "1 to 2"),
        ("--seeds", 3, "1 to 2"),
        ("--episodes", 0, "1 to 6"),
        ("--episodes", 7, "1 to 6"),
        ("--workers", -1, "1 or more"),
        ("--workers", 0, "1 or more"),
        ("--engine", "spark", "dask"),
    ],
)
def test_numbers_out_of_range(capsys, tiny, tmp_path, option, value, valid):
    out = tmp_path / "out"
    line = fails(capsys, "eval", "--controller", "hold", "--protocol", tiny, "--out", out, option, value)
    assert str(value) in line and valid in line
    assert not out.exists()


def test_unwritable_results(capsys, tiny, tmp_path):
    file = tmp_path / "file"
    file.write_text("in the way")
    line = fails(capsys, "eval", "--controller", "hold", "--protocol", tiny, "--out", file / "results")
    assert f"folder '{file / 'results'}' cannot be written" in line


def test_wrong_shape_of_a_user_controller(capsys, tiny, tmp_path):
    spec = write_controller(tmp_path, "flat", "q = q.ravel()")
    out = tmp_path / "out"
    line = fails(capsys, "eval", "--controller", spec, "--protocol", tiny, "--out", out, "--workers", 1)
    assert "expected (6, 14)" in line
    assert not [path for path in out.rglob("*") if path.is_file()]


@pytest.mark.parametrize(
    "arguments",
    [
        ("reach", "--protocol", "smoke_v1"),
        ("compare", "hold", "ik", "--results", "nowhere"),
        ("report", "--results", "nowhere"),
        ("bench", "unheard_of"),
        ("robot", "export", "--out", "nowhere", "--mount", "sideways"),
        ("protocol", "verify", "no_such"),
    ],
    ids=lambda words: " ".join(words[:2]),
)
def test_other_mistakes(capsys, tmp_path, monkeypatch, arguments):
    monkeypatch.chdir(tmp_path)
    fails(capsys, *arguments)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "arguments",
    [
        ("compare", "hold", "ik"),
        ("report",),
        ("replay", "smoke_v1/hold/replicate_0", "--episode", 0),
        ("film", "smoke_v1/hold/replicate_0", "--episode", 0, "-o", "film.mp4"),
    ],
    ids=lambda words: words[0],
)
def test_the_default_folder_without_records_names_the_committed_ones(
    capsys, tmp_path, monkeypatch, arguments
):
    """A checkout holds committed records in `results`; a user's own never go there unasked."""
    monkeypatch.chdir(tmp_path)
    line = fails(capsys, *arguments)
    assert "no records under 'wbc-results'" in line and "--results results" in line
    main(["list"])
    assert "--results results" in capsys.readouterr().out
    assert list(tmp_path.iterdir()) == []


def test_own_runs_are_written_to_and_read_from_the_default_folder(capsys, tiny, monkeypatch):
    monkeypatch.chdir(tiny.parent)
    before = set(tiny.parent.iterdir())
    main(["eval", "--controller", "hold", "--protocol", str(tiny), "--workers", "1"])
    assert set(tiny.parent.iterdir()) - before == {tiny.parent / "wbc-results"}
    main(["report"])
    assert (tiny.parent / "wbc-results/report.html").exists()
    capsys.readouterr()
    main(["list"])
    assert "Runs under wbc-results" in capsys.readouterr().out


def test_no_traceback_and_exit_code_in_a_real_process(tmp_path):
    command = [sys.executable, "-m", "wbc_bench", "ablation", "--seeds", "0"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr.startswith("error: --replicates 0") and done.stderr.count("\n") == 1
    unknown = subprocess.run([*command[:3], "--sedes", "1"], capture_output=True, text=True, cwd=tmp_path)
    assert unknown.returncode == 2 and "Traceback" not in unknown.stderr


def shell(command: str, folder: Path) -> subprocess.CompletedProcess:
    """Run a shell line in which $BENCH is wbc-bench."""
    environment = os.environ | {"BENCH": f"{sys.executable} -m wbc_bench"}
    line = ["bash", "-o", "pipefail", "-c", command]
    return subprocess.run(line, capture_output=True, text=True, cwd=folder, env=environment)


@pytest.mark.parametrize(
    ("words", "near"),
    [
        ("lsit --help", "list"),
        ("nonsense --help", "bench"),
        ("demo evla --help", "eval"),
        ("reprot", "report"),
    ],
)
def test_unknown_command_is_one_line_even_with_help(tmp_path, words, near):
    done = shell(f"$BENCH {words}", tmp_path)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1), done.stderr
    assert done.stderr.startswith("error: unknown command") and near in done.stderr


def test_version_and_completion(tmp_path):
    from importlib.metadata import version

    done = shell("$BENCH --version", tmp_path)
    assert (done.returncode, done.stdout) == (0, f"wbc-bench {version('wbc-bench')}\n")
    text = shell("$BENCH --help", tmp_path).stdout
    assert "--version" in text and "--tyro-print-completion" in text
    done = shell("$BENCH --tyro-print-completion bash", tmp_path)
    assert done.returncode == 0 and "ablation" in done.stdout


@pytest.mark.parametrize("words", ["list", "--help", "--version"])
@pytest.mark.parametrize("reader", ["head -1", "true"])
def test_a_reader_that_goes_away_is_no_error(tmp_path, words, reader):
    """With `true`, the pipe is broken when the buffered output is written, at the end of the command."""
    done = shell(f"$BENCH {words} | {reader}", tmp_path)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
@pytest.mark.parametrize("words", ["list", "--help"])
def test_a_full_disk_is_one_line(tmp_path, words):
    done = shell(f"$BENCH {words} > /dev/full", tmp_path)
    assert (done.returncode, done.stderr) == (2, "error: No space left on device\n")


def test_interrupted_says_that_it_resumes(tmp_path):
    tiny = write_tiny(tmp_path, episodes=120)
    spec = write_controller(tmp_path, "pausing", "time.sleep(0.1)")
    command = [sys.executable, "-m", "wbc_bench", "eval", "--controller", spec, "--protocol", str(tiny)]
    command += ["--out", str(tmp_path), "--workers", "2"]
    process = subprocess.Popen(
        command,
        start_new_session=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # what a script starts in the background inherits that interrupts are ignored
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    deadline = time.monotonic() + 300  # of a process that hangs, on a machine of any load
    while not list(tmp_path.rglob("shard_*.parquet")):
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.01)
    os.killpg(process.pid, signal.SIGINT)  # as Ctrl-C does: every process of the terminal
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "the same command resumes" in errors and "Traceback" not in errors, errors


def test_eval_report_compare_list(capsys, tiny, tmp_path):
    out = tmp_path / "out"
    evaluate(tiny, out)
    assert "12/12" in capsys.readouterr().out
    evaluate(tiny, out, controller=write_controller(tmp_path, "half", "pass"))
    record = json.loads((out / "runs/tiny/hold/replicate_0/run.json").read_text())
    assert (record["requested"], record["completed"]) == (6, 6)
    capsys.readouterr()
    main(["list", "--results", str(out)])
    listed = capsys.readouterr().out
    for word in ("hold", "smoke_v1", "position_error", "half.py"):
        assert word in listed
    spec = f"{tmp_path}/half.py:Mine"
    main(["compare", "hold", spec, "--protocol", "tiny", "--results", str(out), "--out", str(tmp_path / "c")])
    assert len(list((tmp_path / "c").glob("tiny_hold_vs_*"))) == 3
    main(["report", "--results", str(out)])
    first = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    assert out / "report.html" in first and list(out.glob("figures/*.svg")) and list(out.glob("tables/*.tex"))
    main(["report", "--results", str(out)])
    assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == first


def test_compare_finds_runs_by_name_and_by_file(capsys, tiny, tmp_path):
    out = tmp_path / "out"
    evaluate(tiny, out)
    capsys.readouterr()
    main(["compare", "hold", "hold", "--protocol", "tiny", "--results", str(out)])
    by_name = capsys.readouterr().out
    main(["compare", "hold", "hold", "--protocol", str(tiny), "--results", str(out)])
    assert capsys.readouterr().out == by_name
    line = fails(capsys, "compare", "hold", "hold", "--protocol", "tinny", "--results", out)
    assert "'tinny'" in line and "did you mean tiny?" in line and "valid: tiny" in line
    assert str(out) in line


def listed_controllers(text: str) -> list[list[str]]:
    """Cells of the rows of the table of controllers."""
    table = text.partition("## Controllers")[2].partition("\n## ")[0]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()[4:] if line]


def test_every_listed_controller_can_be_given(capsys, tmp_path):
    pytest.importorskip("torch")
    from wbc_bench.registry import load_controller, spec_of_replicate
    from wbc_bench.robot import load_robot

    main(["list", "--results", str(tmp_path)])
    names = [row[0] for row in listed_controllers(capsys.readouterr().out)]
    assert {"hold", "ik", "ik:kinematic", "ik:osqp", "ik:standing", "onnx:FILE.onnx"} <= set(names)
    assert any(name.startswith("learned:") and name.endswith("@0") for name in names)
    for name in names:
        if not re.search("[A-Z]{4}", name):  # FILE, CARD, HOST stand for what a user has
            load_controller(spec_of_replicate(name, 0), load_robot())


def test_list_shows_successes_of_a_method_and_of_its_seed(capsys):
    main(["list", "--results", str(Path(__file__).parents[2] / "results")])
    text = capsys.readouterr().out
    rows = {name: first for name, _, first, *_ in listed_controllers(text)}  # under ablation_v1
    episodes = [int(cell.partition("/")[2]) for cell in rows.values() if cell]
    assert episodes and all(count % 1000 == 0 for count in episodes)
    one_seed = [name for name in rows if rows[name].endswith("/1000") and name.endswith("@0")]
    assert one_seed and all(rows[name] == rows[name.removesuffix("@0")] for name in one_seed)
    assert "## Studies" in text and "| reach_v1 | reach_v1 |" in text


def test_list_needs_no_torch(tmp_path):
    code = "import sys; from wbc_bench.cli.main import main; main(['list']); sys.exit('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "learned:" in done.stdout and "control steps" in done.stdout


def test_installed_factories_without_variants_or_that_fail_are_listed(capsys, tmp_path, monkeypatch):
    from importlib.metadata import EntryPoint

    from wbc_bench import installed

    found = {
        "plain": EntryPoint("plain", "json:dumps", installed.ENTRY_POINTS),
        "gone": EntryPoint("gone", "no_such_module:Mine", installed.ENTRY_POINTS),
    }
    monkeypatch.setattr(installed, "controllers", lambda: found)
    main(["list", "--results", str(tmp_path)])
    rows = {row[0]: row for row in listed_controllers(capsys.readouterr().out)}
    assert rows["plain"][3:] == ["", "json:dumps"]
    assert "cannot be loaded" in rows["gone"][3] and "no_such_module" in rows["gone"][3]


def test_a_failing_report_leaves_the_old_one(capsys, tiny, tmp_path, monkeypatch):
    from wbc_bench.results import report

    evaluate(tiny, tmp_path / "out")
    main(["report", "--results", str(tmp_path / "out")])
    before = {path: path.read_bytes() for path in (tmp_path / "out").rglob("*") if path.is_file()}

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(report, "write", full)
    capsys.readouterr()
    assert "No space left" in fails(capsys, "report", "--results", tmp_path / "out")
    assert {path: path.read_bytes() for path in (tmp_path / "out").rglob("*") if path.is_file()} == before


def test_a_run_grows_and_is_reused_by_less(capsys, tiny, tmp_path):
    evaluate(tiny, tmp_path / "out", "--episodes", 3)
    capsys.readouterr()
    evaluate(tiny, tmp_path / "out")
    assert "| 12/12 |" in capsys.readouterr().out
    evaluate(tiny, tmp_path / "out", "--episodes", 3)
    assert "6 episodes, of which 3 are asked for" in capsys.readouterr().err


def test_ablation_runs_the_study(capsys, tmp_path):
    main(["ablation", "--seeds", "1", "--episodes", "1", "--controllers", "hold", "--out", str(tmp_path)])
    text = capsys.readouterr().out
    assert "1/1" in text and "not evaluated" in text
    assert (tmp_path / "report.html").exists()
    assert len(list((tmp_path / "tables").glob("ablation_v2*.tex"))) >= 4


def test_robot_export(tmp_path):
    import mujoco

    main(["robot", "export", "--out", str(tmp_path)])
    (xml,) = tmp_path.glob("*.xml")
    (urdf,) = tmp_path.glob("*.urdf")
    assert mujoco.MjModel.from_xml_path(str(xml)).nu == 14
    assert urdf.read_text().count('type="revolute"') == 14


def test_protocol_show(capsys, tiny, tmp_path):
    main(["protocol", "show", str(tiny), "--out", str(tmp_path / "pictures")])
    assert "digest" in capsys.readouterr().out
    assert list((tmp_path / "pictures").glob("tiny_targets.*"))


@pytest.mark.parametrize(
    "words, message",
    [
        ("--grid 3 -o a.mp4", "--grid '3': valid: COLUMNSxROWS of 1 to 5 each"),
        ("--grid 0x2 -o a.mp4", "--grid '0x2': valid: COLUMNSxROWS"),
        ("--grid 9x9 -o a.mp4", "--grid '9x9': valid: COLUMNSxROWS"),
        ("--grid 2x2 --strip a.png", "--grid makes a film"),
    ],
)
def test_a_grid_that_cannot_be_filmed_is_one_line(tmp_path, capsys, monkeypatch, words, message):
    monkeypatch.chdir(tmp_path)
    assert message in fails(capsys, "film", "run", "--episode", 0, *words.split())
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("words", ["robot show", "film run --episode 0 --strip x.png"])
def test_a_missing_library_to_draw_with_is_one_line(tmp_path, words):
    """MuJoCo loads it when it is imported, and fails with a traceback of its own."""
    command = [sys.executable, "-c", BROKEN_GL, *words.split()]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 2 and done.stdout == ""
    assert (
        done.stderr.startswith("error: MuJoCo cannot draw with MUJOCO_GL=") and done.stderr.count("\n") == 1
    )


@pytest.mark.parametrize(
    "words",
    [
        "robot show",
        "film run --episode 0 --strip x.png",
        "replay run --episode 0",
        "live --controller hold",
        "track --controller hold --source figure_eight",
    ],
)
def test_a_mujoco_gl_that_does_not_exist_is_one_line(tmp_path, words):
    done = subprocess.run(
        [sys.executable, "-m", "wbc_bench", *words.split()],
        cwd=tmp_path,
        env=os.environ | {"MUJOCO_GL": "vulcan"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 2 and done.stdout == ""
    assert "MUJOCO_GL=vulcan" in done.stderr and done.stderr.count("\n") == 1, done.stderr
    assert not list(tmp_path.iterdir())


BROKEN_GL = """
import builtins, sys
inner = builtins.__import__
def no_mujoco(name, *args, **kwargs):
    if name == "mujoco":
        raise AttributeError("'NoneType' object has no attribute 'glGetError'")
    return inner(name, *args, **kwargs)
builtins.__import__ = no_mujoco
from wbc_bench.cli.main import main
main()
"""
