"""`wbc-bench robot`: export or draw the robot."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import tyro
from tyro.conf import FlagCreatePairsOff

from wbc_bench.cli.common import drawing, print_table

if TYPE_CHECKING:
    from wbc_bench.results.table import Table
    from wbc_bench.robot import Robot, RobotConfig


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


def joint_table(robot: "Robot") -> "Table":
    """The joints of a robot in the order of observations and commands, as the pages show them."""
    from wbc_bench.results.table import Table
    from wbc_bench.robot import JOINT_NAMES

    facts = [robot.default_q, robot.action_scale, robot.kp, robot.kd, robot.effort, robot.velocity]
    rows = [
        (str(k), name, f"{low:.2f} to {high:.2f}", *(f"{column[k]:g}" for column in facts))
        for k, (name, low, high) in enumerate(zip(JOINT_NAMES, robot.lower, robot.upper, strict=True))
    ]
    header = ("Index", "Joint", "Range (rad)", "Default (rad)", "Action scale (rad)", "kp (N m/rad)")
    header += ("kd (N m s/rad)", "Effort (N m)", "Speed (rad/s)")
    return Table("joints", f"Joints of the variant {robot.config.variant}", header, tuple(rows))


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
    """Draw the robot in its default posture, or list its joints."""

    out: Path = Path("robot.png")
    """Path of the picture to write, FILE.png."""
    joints: FlagCreatePairsOff[bool] = False
    """Print the joints in the order of commands, with range, default posture, gains and torque limit, instead
    of drawing."""

    def run(self) -> None:
        if self.joints:
            from wbc_bench.robot import load_robot

            print_table(joint_table(load_robot(self._config())))
            return
        drawing()
        from wbc_bench.files import ensure_file_writable
        from wbc_bench.robot import load_robot
        from wbc_bench.viewer.picture import render

        robot = load_robot(self._config())
        ensure_file_writable(self.out)
        render(robot, self.out)
        print(self.out)
