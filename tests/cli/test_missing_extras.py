"""What is not installed is named in one line, with the command that installs it."""

import subprocess
import sys

import pytest

# A module that cannot be found; `None` in `sys.modules` would make some packages believe it loaded.
HIDE = """
import sys
class Hidden:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] == sys.argv[1]:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Hidden())
from {} import main
main(sys.argv[2:])
"""

# module that is hidden, package and extra in the message, command
CASES = [
    ("pinocchio", "pin", "ik", ("eval", "--controller", "ik", "--protocol", "smoke_v1")),
    ("daqp", "daqp", "ik", ("eval", "--controller", "ik:standing", "--protocol", "smoke_v1")),
    ("placo", "placo", "ik", ("eval", "--controller", "ik:placo", "--protocol", "smoke_v1")),
    ("osqp", "osqp", "ik", ("eval", "--controller", "ik:osqp", "--protocol", "smoke_v1")),
    ("onnxruntime", "onnxruntime", "policy", ("policy", "import", "pyproject.toml")),
    ("torch", "torch", "learned", ("export", "--controller", "learned:no_latent@0", "-o", "policy.onnx")),
    (
        "onnxruntime",
        "onnxruntime",
        "learned",
        ("eval", "--controller", "onnx:policy.onnx", "--protocol", "smoke_v1"),
    ),
    ("pinocchio", "pin", "bench", ("bench", "ik")),
    ("viser", "viser", "view", ("live", "--controller", "hold")),
    ("torch", "torch", "diffusion", ("live", "--controller", "hold", "--source", "diffusion")),
    ("torch", "torch", "diffusion", ("demo", "train", "none.zarr.zip", "-o", "policy.safetensors")),
    ("zmq", "pyzmq", "live", ("live", "--controller", "hold", "--source", "stream")),
    (
        "distributed",
        "distributed",
        "cluster",
        ("eval", "--controller", "hold", "--protocol", "smoke_v1", "--engine", "dask"),
    ),
]


RUN = ("wbc-train", "run", "--method", "no_latent", "--num-envs", "16", "--estimator-mini-batches", "1")
CASES += [
    ("torch", "torch", "learned", RUN),
    ("rsl_rl", "rsl-rl-lib", "learned", RUN),
    ("mujoco_warp", "mujoco-warp", "warp", (*RUN, "--backend", "warp")),
    ("warp", "warp-lang", "warp", (*RUN, "--backend", "warp")),
]


@pytest.mark.parametrize(
    ("module", "package", "extra", "command"),
    CASES,
    ids=[f"{case[0]}-{'-'.join(case[3][:3])}" for case in CASES],
)
def test_a_missing_extra_is_one_line(
    tmp_path, module: str, package: str, extra: str, command: tuple[str, ...]
):
    program = "wbc_bench.cli.main"
    if command[0] == "wbc-train":
        program, command = "wbc_baselines.learned.training.cli", command[1:]
    line = [sys.executable, "-c", HIDE.format(program), module, *command]
    done = subprocess.run(line, capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 2, done.stderr
    assert "Traceback" not in done.stderr
    last = done.stderr.strip().splitlines()[-1]
    assert f"needs the package {package}: pip install 'wbc-bench[{extra}]'" in last
