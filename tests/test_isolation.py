"""A controller's code neither disturbs others nor is disturbed: arrays, global random streams, faults."""

import os
import random
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tiny_protocol import write_tiny
from wbc_bench.episodes.manifest import manifest_path, read_manifest
from wbc_bench.episodes.protocol import find_protocol
from wbc_bench.errors import ControllerError
from wbc_bench.evaluation.evaluate import evaluate
from wbc_bench.evaluation.latents import sample_latents
from wbc_bench.isolation import GlobalRandomness
from wbc_bench.provenance import software
from wbc_bench.registry import load_controller
from wbc_bench.robot import load_robot

HEAD = """
import random
import numpy as np
from wbc_bench.controller import SIGNALS, ControllerInfo, JointCommand

class Mine:
    info = ControllerInfo("mine", frozenset(SIGNALS), 0.02, "test")

    def __init__(self, robot):
        self.robot, self.q = robot, robot.default_q

    def reset(self, episodes, obs, target):
        pass

    def act(self, obs, target):
        return JointCommand(np.tile(self.q, (len(obs.active), 1)) + self.more(obs, target))

    def more(self, obs, target):
        return 0.0
"""


def controller(folder: Path, name: str, body: str) -> str:
    path = folder / f"{name}.py"
    path.write_text(HEAD + "".join(f"    {line}\n" for line in body.strip("\n").splitlines()))
    return f"{path}:Mine"


def rows(spec: str, protocol: Path, **options):
    return evaluate(spec, str(protocol), **options).episodes


DRAWS = """
def more(self, obs, target):
    return 0.1 * random.random() + 0.1 * np.random.rand()
"""
OWN = """
def seed(self, rng):
    self.rng = rng

def more(self, obs, target):
    return 0.1 * self.rng.random()
"""


@pytest.mark.parametrize("body", [DRAWS, OWN], ids=["global generators", "its own stream"])
def test_random_controllers_are_repeatable(tmp_path: Path, body: str) -> None:
    """Whatever was drawn before, by one worker or by two; and the draws of the caller stay what they were."""
    protocol = write_tiny(tmp_path, replicates=2, episodes=6)
    spec = controller(tmp_path, f"draws_{len(body)}", body)
    random.seed(5)
    np.random.seed(5)  # noqa: NPY002
    wanted = random.random(), np.random.rand()  # noqa: NPY002
    first = rows(spec, protocol)
    random.seed(5)
    np.random.seed(5)  # noqa: NPY002
    again = rows(spec, protocol)
    assert (random.random(), np.random.rand()) == wanted  # noqa: NPY002
    assert first.equals(again)
    assert first.equals(rows(spec, protocol, workers=2))
    assert len(set(first["action_variation"])) > 1  # it does draw, and otherwise in other shards


TORCH = """
import torch

def __init__(self, robot):
    self.q, self.weight = robot.default_q, self.torch.rand(1).item()

def more(self, obs, target):
    return 0.1 * self.weight * self.torch.rand(1).item()
"""


def test_torch_draws_the_same_whoever_imported_it(tmp_path: Path) -> None:
    """By itself it begins at the entropy of the machine."""
    torch = pytest.importorskip("torch")
    protocol, spec = write_tiny(tmp_path), controller(tmp_path, "draws_torch", TORCH)
    code = (
        "import sys\n{}\nfrom wbc_bench import evaluate\n"
        f"print(evaluate({spec!r}, {str(protocol)!r}).episodes['action_variation'].tolist())"
    )
    found = [
        subprocess.run([sys.executable, "-c", code.format(first)], capture_output=True, text=True).stdout
        for first in ("", "import torch; torch.manual_seed(9)")
    ]
    assert found[0] == found[1] != ""
    torch.manual_seed(4)
    expected = torch.rand(1).item()
    torch.manual_seed(4)
    with GlobalRandomness(1).own():
        torch.rand(7)
    assert torch.rand(1).item() == expected


IMPORT_DRAWS = """
{imports}
AT_IMPORT = {draw}

class Drawn(Mine):
    def __init__(self, robot):
        self.at_import, self.first = AT_IMPORT, {draw}
"""


@pytest.mark.parametrize("draw", ["random.random()", "np.random.rand()", "float(torch.rand(1))"])
def test_what_an_import_draws_does_not_shift_the_factory(tmp_path: Path, draw: str) -> None:
    """Nor does it depend on who imported PyTorch: workers and clients import at different times."""
    torch = draw.startswith("float(torch")
    if torch:
        pytest.importorskip("torch")
    path = tmp_path / "draws_at_import.py"
    path.write_text(HEAD + IMPORT_DRAWS.format(draw=draw, imports="import torch" if torch else ""))
    code = (
        "{first}\nfrom wbc_bench.registry import load_controller\nfrom wbc_bench.robot import load_robot\n"
        f"made = [load_controller('{path}:Drawn', load_robot()) for _ in range(2)]\n"
        "print(*[(mine.at_import, mine.first) for mine in made], sep='\\n')"
    )
    found = [
        subprocess.run([sys.executable, "-c", code.format(first=first)], capture_output=True, text=True)
        for first in ("", "import torch; torch.rand(3)" if torch else "import random; random.random()")
    ]
    lines = [line for run in found for line in run.stdout.splitlines()]
    assert len(lines) == 4 and len(set(lines)) == 1, [run.stderr for run in found]


SHARED = "import random\nAT_IMPORT = random.random()\n"
SHARES = """
random.random()
import {helper}

class Drawn(Mine):
    def __init__(self, robot):
        import {helper}_inside
        self.drawn = {helper}.AT_IMPORT, {helper}_inside.AT_IMPORT, random.random()
"""


def test_what_a_shared_helper_draws_does_not_depend_on_who_imported_it(tmp_path: Path) -> None:
    """Two controllers of a folder import it, one of them after it has drawn, at the top and in a function."""
    (tmp_path / "drawn_helper.py").write_text(SHARED)
    (tmp_path / "drawn_helper_inside.py").write_text(SHARED)
    text = HEAD + SHARES.format(helper="drawn_helper")
    (tmp_path / "shares_a.py").write_text(text)
    (tmp_path / "shares_b.py").write_text(text.replace("random.random()\nimport", "import"))
    code = (
        "from wbc_bench.registry import load_controller\nfrom wbc_bench.robot import load_robot\n"
        "drawn = {{name: load_controller(f'{folder}/shares_{{name}}.py:Drawn', load_robot()).drawn\n"
        "         for name in {order!r}}}\nprint([drawn[name] for name in 'ab'])"
    )
    found = [
        subprocess.run(
            [sys.executable, "-c", code.format(folder=tmp_path, order=order)], capture_output=True, text=True
        )
        for order in ("ab", "ba")
    ]
    assert found[0].stdout == found[1].stdout != "", found[0].stderr


def test_helpers_of_one_name_are_not_mixed_up(tmp_path: Path) -> None:
    for folder, share in (("one", 0.1), ("two", 0.9)):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "namesake.py").write_text(f"SHARE = {share}\n")
        path = tmp_path / folder / f"of_{folder}.py"
        path.write_text(f"import namesake\n{HEAD}    share = namesake.SHARE\n")
    assert load_controller(f"{tmp_path}/one/of_one.py:Mine", load_robot()).share == 0.1  # pyright: ignore
    with pytest.raises(ControllerError, match="of the same name: give one of them another"):
        load_controller(f"{tmp_path}/two/of_two.py:Mine", load_robot())
    (tmp_path / "two" / "namesake.py").rename(tmp_path / "two" / "another.py")
    path = tmp_path / "two" / "of_two.py"
    path.write_text(path.read_text().replace("namesake", "another"))
    assert load_controller(f"{path}:Mine", load_robot()).share == 0.9  # pyright: ignore


def test_a_digest_draws_from_streams_of_its_own(tmp_path: Path) -> None:
    body = "def digest(self):\n    return f'{random.random()} {np.random.rand()}'"
    drawing = load_controller(controller(tmp_path, "digest_draws", body), load_robot())
    random.seed(1)
    first, state = software(drawing).controller, random.getstate()
    random.seed(2)
    assert software(drawing).controller == first
    random.seed(1)
    assert random.getstate() == state


def test_streams_go_on_where_they_were_left() -> None:
    mine = GlobalRandomness(7)
    with mine.own():
        a = random.random()
    random.random()
    with mine.own():
        b = random.random()
    again = GlobalRandomness(7)
    with again.own():
        assert [random.random(), random.random()] == [a, b]


@pytest.mark.parametrize(
    "line",
    [
        "self.robot.default_q += 1",
        "self.robot.kp[0] = 0",
        "obs.proprioception.joint_pos[:] = 0",
        "obs.base_pose.pos_w[:] = 0",
        "obs.privileged.friction[:] = 9",
        "obs.ee_pose.pos_b[:] = 0",
        "target.pos_b[:] = 0",
    ],
)
def test_what_is_handed_out_cannot_be_written_to(tmp_path: Path, line: str) -> None:
    before = load_robot().default_q.copy()
    body = f"def more(self, obs, target):\n    {line}\n    return 0.0"
    spec = controller(tmp_path, f"writes_{abs(hash(line))}", body)
    with pytest.raises(ControllerError, match=r"control step 0 of episodes 0 to 5: ValueError: .*read-only"):
        rows(spec, write_tiny(tmp_path))
    np.testing.assert_array_equal(load_robot().default_q, before)


def test_episode_numbers_are_a_copy(tmp_path: Path) -> None:
    spec = controller(tmp_path, "renumbers", "def reset(self, episodes, obs, target):\n    episodes[:] = 99")
    assert sorted(rows(spec, write_tiny(tmp_path))["episode"].unique()) == list(range(6))


FAULTS = {
    "needs_two": "class Odd(Exception):\n    def __init__(self, a, b):\n        self.b = b\nraise Odd(1, 2)",
    "locked": "import threading\nerror = ValueError('locked')\nerror.lock = threading.Lock()\nraise error",
    "mute": "class Mute(Exception):\n    def __str__(self):\n        raise RuntimeError\nraise Mute",
    "huge": "raise ValueError('x' * 10_000_000)",
    "nested": "try:\n    1 / 0\nexcept ZeroDivisionError as cause:\n    raise LookupError('in') from cause",
    "leaves": "raise SystemExit(0)",
    "base": "class Odder(BaseException):\n    pass\nraise Odder('of its own kind')",
    "generator": "raise GeneratorExit('closing')",
}


@pytest.mark.parametrize("workers", [1, 2])
@pytest.mark.parametrize("kind", FAULTS)
def test_any_exception_comes_back_as_the_user_s_own_frames(tmp_path: Path, kind: str, workers: int) -> None:
    body = "def more(self, obs, target):\n" + "".join(f"    {line}\n" for line in FAULTS[kind].splitlines())
    spec = controller(tmp_path, f"fails_{kind}_{workers}", body)
    with pytest.raises(ControllerError) as caught:
        rows(spec, write_tiny(tmp_path), workers=workers)
    said = str(caught.value)
    assert "'mine' failed in `act` at control step 0 of episodes 0 to 5" in said
    assert f"fails_{kind}_{workers}.py" in said and "in more" in said and len(said) < 1200


def test_an_interrupt_raised_by_a_controller_is_its_fault_in_a_worker(tmp_path: Path) -> None:
    spec = controller(tmp_path, "interrupts", "def more(self, obs, target):\n    raise KeyboardInterrupt")
    place = "'mine' failed in `act` at control step 0 of episodes 0 to 5: KeyboardInterrupt"
    for engine in ("loky", "dask"):
        with pytest.raises(ControllerError, match=rf"{place}: .*interrupts.py:\d+ in more"):
            rows(spec, write_tiny(tmp_path), workers=2, engine=engine)
    with pytest.raises(KeyboardInterrupt):  # in the user's own process it may be the user's
        rows(spec, write_tiny(tmp_path), workers=1)


def test_an_interrupt_raised_by_a_factory_is_its_fault_in_a_worker(tmp_path: Path) -> None:
    body = f"""
def __init__(self, robot):
    self.q = robot.default_q
    if __import__("os").getpid() != {os.getpid()}:
        raise KeyboardInterrupt
"""
    spec = controller(tmp_path, "unmade_apart", body)
    said = r"unmade_apart.py:Mine' cannot be made: KeyboardInterrupt: .*unmade_apart.py:\d+ in __init__"
    with pytest.raises(ControllerError, match=said):
        rows(spec, write_tiny(tmp_path), workers=2)


def test_a_factory_that_fails_is_one_line(tmp_path: Path) -> None:
    spec = controller(tmp_path, "unmade", "def __init__(self, robot):\n    raise OSError('no such weights')")
    with pytest.raises(ControllerError, match=r"cannot be made: OSError: no such weights \(unmade.py:\d+ in"):
        rows(spec, write_tiny(tmp_path))


ODD_COMMANDS = {
    "np.full((6, 14), 'a')": r"commands of type <U1, e.g. .*'a'.*, at control step 0, valid: real numbers",
    "np.full((6, 14), None)": "commands of type object, e.g. None, at",
    "[[object()] * 14] * 6": "commands of type object, e.g. <object object at 0x",
    "None": "commands of type object, e.g. None, at",
    "np.zeros((6, 14), complex)": "commands of type complex128, e.g. .*0j.*, at",
    "np.zeros((6, 14), 'datetime64[s]')": "commands of type datetime64",
    "[[0.0] * 14] * 5 + [[0.0]]": r"failed in `act` at control step 0 .*; commands are no array, expected",
    "{'q': 0.0}": "commands of type object",
    "np.zeros((6, 13))": r"commands of shape \(6, 13\), expected \(6, 14\)",
    "np.zeros((6, 14)), ['no'] * 6": "`infeasible` of type <U2, e.g. .*'no'.*, at .*, valid: booleans",
    "np.zeros((6, 14)), np.zeros(5, bool)": r"`infeasible` of shape \(5,\), expected \(6,\)",
}


@pytest.mark.parametrize("command", ODD_COMMANDS)
def test_a_command_that_is_no_array_of_numbers_is_one_line(tmp_path: Path, command: str) -> None:
    body = f"def act(self, obs, target):\n    return JointCommand({command})"
    spec = controller(tmp_path, f"odd_{list(ODD_COMMANDS).index(command)}", body)
    with pytest.raises(ControllerError, match=ODD_COMMANDS[command]) as caught:
        rows(spec, write_tiny(tmp_path))
    assert "controller 'mine'" in str(caught.value) and len(str(caught.value)) < 700


@pytest.mark.parametrize(
    ("info", "said"),
    [
        ("'mine', frozenset(), '0.02', 'test'", "has the control period '0.02', valid: a number"),
        ("'mine', frozenset(), 0.02, 'test', (5,)", r"has `info.files` \(5,\), valid: paths"),
        ("'mine', None, 0.02, 'test'", "cannot be made: TypeError: 'NoneType' object is not iterable"),
    ],
)
def test_an_odd_info_is_one_line(tmp_path: Path, info: str, said: str) -> None:
    name = f"odd_info_{abs(hash(info))}"
    spec = controller(tmp_path, name, f"info = ControllerInfo({info})")
    with pytest.raises(ControllerError, match=said):
        rows(spec, write_tiny(tmp_path))


INSTALLED = """
class Factory:
    def __call__(self, robot, variant=""):
        return Mine(robot)

    def variants(self):
        {variants}

    def variant_for(self, variant, replicate):
        {variant_for}

class Mine(Mine):
    formats = ("bin",)

    def export(self, path, format):
        path.write_text("half")
        {export}

make = Factory()
"""


def install(folder: Path, monkeypatch: pytest.MonkeyPatch, **bodies: str) -> None:
    """Have a file stand as the installed controller `theirs`, some of whose methods are given."""
    from importlib.metadata import EntryPoint

    from wbc_bench import installed, registry

    plain = {"variants": "return [('', 'plain')]", "variant_for": "return variant", "export": "pass"}
    name = f"installed_{abs(hash(str(sorted(bodies.items()))))}"
    (folder / f"{name}.py").write_text(HEAD + INSTALLED.format(**plain | bodies))
    monkeypatch.syspath_prepend(folder)
    found = {"theirs": EntryPoint("theirs", f"{name}:make", installed.ENTRY_POINTS)}
    monkeypatch.setattr(installed, "controllers", lambda: found)
    monkeypatch.setattr(registry, "controllers", lambda: found)


@pytest.mark.parametrize(
    ("method", "body", "said"),
    [
        ("variant_for", "raise SystemExit(3)", "failed in `variant_for`: SystemExit: 3 (installed_"),
        ("variant_for", "return None", "returned None from `variant_for`, valid: a text"),
        ("export", "raise LookupError('no such op')", "failed in `export`: LookupError: no such op (inst"),
        ("export", "path.unlink()", "failed in `export`: it wrote no file 'out.bin'"),
        ("variants", "raise SystemExit(3)", "cannot be loaded: controller 'theirs' failed in `variants`"),
        ("variants", "return [1, 2]", "cannot be loaded: controller 'theirs' failed in `variants`: TypeErr"),
    ],
)
def test_a_factory_or_an_export_that_fails_is_one_line(
    tmp_path: Path, monkeypatch, capsys, method: str, body: str, said: str
) -> None:
    from wbc_bench.cli.main import main

    install(tmp_path, monkeypatch, **{method: body})
    written = tmp_path / "made" / "out.bin"
    written.parent.mkdir()
    written.write_text("of before")
    arguments = {
        "variants": ["list", "--results", str(tmp_path)],
        "export": ["export", "--controller", "theirs", "--format", "bin", "-o", str(written)],
        "variant_for": ["eval", "--controller", "theirs", "--protocol", str(write_tiny(tmp_path))],
    }[method]
    if method == "variants":  # whoever wants the list gets the rest of it
        main(arguments)
        text = capsys.readouterr().out
    else:
        with pytest.raises(SystemExit, match="2"):
            main(arguments)
        text = capsys.readouterr().err
        assert len(text.splitlines()) == 1
    assert said in text
    assert [file.name for file in written.parent.iterdir()] == ["out.bin"]
    assert written.read_text() == "of before"


def test_an_export_takes_the_place_of_the_one_before(tmp_path: Path, monkeypatch, capsys) -> None:
    from wbc_bench.cli.main import main

    install(tmp_path, monkeypatch, export="path.with_suffix('.data').write_text('weights')")
    (tmp_path / "out.bin").write_text("of before")
    main(["export", "--controller", "theirs", "--format", "bin", "-o", str(tmp_path / "out.bin")])
    assert (tmp_path / "out.bin").read_text() == "half" and (tmp_path / "out.data").exists()


def test_a_digest_that_fails_is_one_line(tmp_path: Path) -> None:
    spec = controller(tmp_path, "undigested", "def digest(self):\n    raise SystemExit('no such variable')")
    said = r"'Mine' failed in `digest`: SystemExit: no such variable \(undigested.py:\d+ in digest\)"
    with pytest.raises(ControllerError, match=said):
        rows(spec, write_tiny(tmp_path))


def test_a_latent_that_fails_is_one_line_and_draws_from_streams_of_its_own(tmp_path: Path) -> None:
    body = """
steps = 0

def latent(self):
    self.steps += 1
    if self.steps == 3:
        raise LookupError("none yet")
    return np.full((6, 2), random.random())
"""
    protocol, path = find_protocol(str(write_tiny(tmp_path)))
    manifest, _ = read_manifest(protocol, manifest_path(path))
    mine = load_controller(controller(tmp_path, "shown", body), load_robot(protocol.robot))
    outside = random.getstate()
    with pytest.raises(ControllerError, match=r"in `latent` at control step 3 .*: none yet \(shown"):
        sample_latents(mine, protocol, manifest.of_replicate(0, 6))
    assert random.getstate() == outside
