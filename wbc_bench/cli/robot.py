"""`wbc-bench robot`: export or draw the robot."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from wbc_bench.cli.common import drawing

if TYPE_CHECKING:
    from wbc_bench.robot import RobotConfig


@dataclass(frozen=True)
class _Robot:
    variant: str = "limx_adapter"
    """Name of the robot's build: limx_adapter, or paper for the one of the paper's public code."""
    mount: str = ""
    """Name of the place where the arm is mounted; that of the variant when not given."""
    tcp: str = ""
    """Name of the end-effector frame; that of the variant when not given."""
    ankle_effort: float | None = None
    """Torque limit of the ankles [N m]; that of the variant when not given."""

    def _config(self) -> "RobotConfig":
        from wbc_bench.robot import RobotConfig

        return RobotConfig(
            variant=self.variant, mount=self.mount, tcp=self.tcp, ankle_effort=self.ankle_effort
        )


@dataclass(frozen=True)
class Export(_Robot):
    """Write the robot as MuJoCo XML and as URDF."""

    out: Path = tyro.MISSING
    """Folder to write the XML file and the URDF file to."""

    def run(self) -> None:
        from wbc_bench.files import ensure_writable, write_atomic
        from wbc_bench.robot import build_spec, load_robot

        robot = load_robot(self._config())
        ensure_writable(self.out)
        spec = build_spec(robot.facts, robot.config)
        spec.compile()  # to_xml writes what was compiled
        for suffix, text in (("xml", spec.to_xml()), ("urdf", robot.urdf())):
            path = self.out / f"{robot.facts.name}.{suffix}"
            write_atomic(path, text.encode())
            print(path)


@dataclass(frozen=True)
class Picture(_Robot):
    """Draw the robot in its default posture."""

    out: Path = Path("robot.png")
    """Path of the picture to write, FILE.png."""

    def run(self) -> None:
        drawing()
        from wbc_bench.files import ensure_writable
        from wbc_bench.robot import load_robot
        from wbc_bench.viewer.picture import render

        robot = load_robot(self._config())
        ensure_writable(self.out.parent)
        render(robot, self.out)
        print(self.out)
