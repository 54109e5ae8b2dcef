"""First cards from what other stacks write beside a policy: mjlab, Isaac Lab, Unitree."""

import re
from pathlib import Path
from typing import Any

from wbc_bench.errors import ControllerError, missing_extra
from wbc_bench.policies.onnx_network import open_session
from wbc_bench.policies.terms import TERMS
from wbc_bench.readers import read_text, reading
from wbc_bench.robot import JOINT_NAMES

# names of other stacks for terms of the vocabulary
SYNONYMS = {
    "actions": "last_action",
    "joint_pos_rel": "joint_pos_rel",
    "joint_vel": "joint_vel_rel",
    "joint_pos": "joint_pos_rel",
    "generated_commands": "velocity_commands",
    "command": "velocity_commands",
    "velocity_command": "velocity_commands",
    "pose_command": "ee_target",
    "ee_pose_command": "ee_target",
    "imu_ang_vel": "base_ang_vel",
    "imu_projected_gravity": "projected_gravity",
}


class Draft:
    """A card while it is collected: lines of TOML, and what is still missing."""

    def __init__(self, network: Path) -> None:
        self.network, self.missing = network, []
        self.top: dict[str, Any] = {"name": network.stem}
        self.terms: list[dict[str, Any]] = []
        self.action: dict[str, Any] = {}
        self.group: dict[str, Any] = {}

    def joints(self, names: Any) -> None:
        """Take the joint order; names that this robot does not have are asked for."""
        names = _texts(names)
        unknown = [name for name in names if name not in JOINT_NAMES]
        if unknown:
            self.missing.append(
                f"joints: {', '.join(unknown)} are no joints of this robot, valid: {', '.join(JOINT_NAMES)}"
            )
        self.top["joints"] = names

    def term(self, name: str, **options: Any) -> None:
        """Take an observation term."""
        known = SYNONYMS.get(name, name)
        if known not in TERMS:
            self.missing.append(f"term '{name}' of the description, valid: {', '.join(TERMS)}")
        given = {key: value for key, value in options.items() if value not in (None, [], ())}
        if known in ("velocity_commands", "constant"):
            given.setdefault("value", [0.0, 0.0, 0.0])
        self.terms.append({"term": known, **given})

    def text(self) -> str:
        """The card as TOML."""
        session = open_session(self.network)
        inputs, outputs = (
            [value.name for value in values] for values in (session.get_inputs(), session.get_outputs())
        )
        states = _states(inputs, outputs)
        plain = [name for name in inputs if name not in states]
        rest = [name for name in outputs if name not in states.values()]
        if len(plain) > 1:
            self.missing.append(f"which observation each of the inputs {', '.join(plain)} reads")
        if not self.terms:
            self.missing.append(
                "the observation terms, in order; wbc-bench policy terms lists the vocabulary"
            )
        for key, why in (("joints", "the order of joints"), ("control_period", "the control period [s]")):
            if key not in self.top:
                self.missing.append(f"{key}: {why}")
        if "scale" not in self.action:
            self.missing.append("action.scale [rad]")
        lines = [*(f"# missing: {text}" for text in self.missing)]
        lines += [f"{key} = {_toml(value)}" for key, value in self.top.items()]
        lines += ["", "[[observation]]", 'name = "policy"']
        lines += [f"{key} = {_toml(value)}" for key, value in self.group.items()]
        lines += ["terms = [", *(f"    {_toml(term)}," for term in self.terms), "]"]
        lines += ["", "[[network]]", f"file = {_toml(self.network.name)}"]
        lines += [f"inputs = {_toml({name: 'policy' for name in plain})}"]
        lines += [f"outputs = {_toml({rest[0]: 'action'} if rest else {})}"]
        pairs = [{"input": one, "output": other} for one, other in states.items()]
        lines += [f"state = {_toml(pairs)}"] if pairs else []
        lines += ["", "[action]", *(f"{key} = {_toml(value)}" for key, value in self.action.items())]
        return "\n".join(lines) + "\n"


def draft(network: Path, description: Path | None) -> Draft:
    """The card of an ONNX file and of a description beside it, or of its own metadata.

    Raises: ControllerError, a file cannot be read or is of no known kind.
    """
    found = Draft(network)
    if description is None:
        _from_metadata(found, open_session(network).get_modelmeta().custom_metadata_map)
        return found
    content = _yaml(description)
    kinds = "an Isaac Lab IO descriptor or a Unitree deploy.yaml"
    with reading("description", description, kinds, ControllerError):
        if "articulations" in content:
            _from_isaac(found, content)
        elif "joint_ids_map" in content or "step_dt" in content:
            _from_unitree(found, content)
        else:
            keys = ", ".join(map(str, list(content)[:8]))
            raise ControllerError(
                f"description '{description}' has {keys}, valid: {kinds}, with `articulations` or `step_dt`"
            )
    return found


def _from_metadata(found: Draft, data: dict[str, str]) -> None:
    """Source: mjlab's exporter, which writes lists as texts joined by commas."""

    def listed(key: str) -> list[str]:
        return [part.strip() for part in data.get(key, "").strip("[]").split(",") if part.strip()]

    def floats(key: str) -> list[float]:
        return [float(part) for part in listed(key)]

    if "joint_names" in data:
        found.joints(listed("joint_names"))
    for name in listed("observation_names"):
        found.term(name)
    with reading("metadata", found.network, "numbers joined by commas", ControllerError):
        if "default_joint_pos" in data and "joint_names" in data:
            found.top["default_posture"] = dict(
                zip(listed("joint_names"), floats("default_joint_pos"), strict=True)
            )
        for key, name in (("kp", "joint_stiffness"), ("kd", "joint_damping"), ("scale", "action_scale")):
            if name in data:
                values = floats(name)
                found.action[key] = values[0] if len(values) == 1 else values


def _from_isaac(found: Draft, content: dict) -> None:
    """Source: Isaac Lab's IO descriptors (`IO_descriptors.yaml`)."""
    robot = next(iter(content["articulations"].values()))
    names = _texts(robot["joint_names"])
    found.joints(names)
    found.top["default_posture"] = dict(zip(names, _floats(robot["default_joint_pos"]), strict=True))
    scene = content.get("scene", {})
    if "dt" in scene or "physics_dt" in scene:
        found.top["control_period"] = float(
            scene.get("dt", scene.get("physics_dt", 0) * scene.get("decimation", 1))
        )
    groups = content.get("observations", {})
    for term in groups.get("policy", next(iter(groups.values()), ())):
        options = term.get("overloads", {})
        length = int(options.get("history_length") or 0)
        joints = term.get("joint_names")
        found.term(
            str(term["name"]),
            joints=_texts(joints) if joints and _texts(joints) != names else None,
            scale=_scale(options.get("scale")),
            clip=options.get("clip") and _floats(options["clip"]),
            history=length if length > 1 else None,
        )
    action = next(iter(content.get("actions", ())), {})
    driven = _texts(action.get("joint_names", ()))
    if driven and driven != names:
        found.action["joints"] = driven
    for key in ("scale", "offset"):
        if _scale(action.get(key)) is not None:
            found.action[key] = _scale(action[key])
    chosen = driven or names
    for key, name in (("kp", "default_joint_stiffness"), ("kd", "default_joint_damping")):
        if name in robot:
            found.action[key] = [dict(zip(names, _floats(robot[name]), strict=True))[one] for one in chosen]


def _from_unitree(found: Draft, content: dict) -> None:
    """Source: unitree_rl_lab's deploy.yaml."""
    if "step_dt" in content:
        found.top["control_period"] = float(content["step_dt"])
    action = next(iter(content.get("actions", {}).values()), {})
    if action.get("joint_names"):
        found.joints(action["joint_names"])
    names = found.top.get("joints", [])
    posture = _floats(content.get("default_joint_pos", ()))
    if names and len(posture) == len(names):
        found.top["default_posture"] = dict(zip(names, posture, strict=True))
    for name, options in content.get("observations", {}).items():
        length = int(options.get("history_length") or 0)
        found.term(
            str(name),
            scale=_scale(options.get("scale")),
            clip=options.get("clip") and _floats(options["clip"]),
            history=length if length > 1 else None,
        )
    for key, value in (("scale", action.get("scale")), ("offset", action.get("offset"))):
        if _scale(value) is not None:
            found.action[key] = _scale(value)
    for key, name in (("kp", "stiffness"), ("kd", "damping")):
        if content.get(name):
            found.action[key] = _floats(content[name])


def _states(inputs: list[str], outputs: list[str]) -> dict[str, str]:
    """Input -> output of recurrent states, by their names: `h_in` and `h_out`, `x` and `next_x`."""
    found = {}
    for name in inputs:
        for other in (re.sub(r"_in$", "_out", name), f"next_{name}", f"{name}_out"):
            if other != name and other in outputs:
                found[name] = other
                break
    return found


def _yaml(path: Path) -> dict:
    try:
        import yaml
    except ImportError as error:
        raise ControllerError(missing_extra("a description in YAML", "policy", error)) from error
    text = read_text(path, "description", ControllerError)
    with reading("description", path, "YAML", ControllerError):
        content = yaml.safe_load(text)  # makes no objects but those of JSON
    if not isinstance(content, dict):
        raise ControllerError(f"description '{path}' holds {type(content).__name__}, valid: a table of YAML")
    return content


def _texts(values: Any) -> list[str]:
    return [str(value) for value in values]


def _floats(values: Any) -> list[float]:
    return [float(value) for value in values]


def _scale(value: Any) -> float | list[float] | None:
    if value is None:
        return None
    values = _floats(value) if isinstance(value, list | tuple) else [float(value)]
    return values[0] if len(set(values)) == 1 else values


def _toml(value: Any) -> str:
    """A value of TOML on one line."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{_toml(str(key))} = {_toml(item)}" for key, item in value.items()) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_toml, value)) + "]"
    if isinstance(value, str):
        escaped = value.replace("\\", "\\\\").replace('"', '\\"')
        return '"' + "".join(c if c.isprintable() else " " for c in escaped) + '"'
    return repr(value)
