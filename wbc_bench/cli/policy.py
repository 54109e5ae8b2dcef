"""`wbc-bench policy`: a card for a policy of another stack, and whether the card is right."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from tyro.conf import FlagCreatePairsOff, Positional

from wbc_bench.cli.common import UsageError, print_table

if TYPE_CHECKING:
    from wbc_bench.evaluation.policy_check import Verdict
    from wbc_bench.results.table import Table


@dataclass(frozen=True)
class PolicyImport:
    """Write a first card for an ONNX file, and say what is missing in it.

    Of a PyTorch checkpoint, FILE.pt, the actor is written as FILE.onnx first.
    """

    network: Positional[Path]
    """Path of the policy, FILE.onnx, or of a checkpoint of rsl_rl, FILE.pt; no code in it runs."""
    description: Path | None = None
    """Path of an Isaac Lab IO descriptor or a Unitree deploy.yaml; its metadata when not given."""
    activation: Literal["Elu", "Relu", "Tanh", "Selu", "LeakyRelu"] = "Elu"
    """Function between the layers of a checkpoint, which does not hold it."""
    out: Path | None = None
    """Path of the card to write, beside the policy; FILE.toml when not given."""

    def run(self) -> None:
        from wbc_bench.files import real_path, write_atomic
        from wbc_bench.policies.descriptions import draft

        out = self.out or self.network.with_suffix(".toml")
        if out.exists():
            raise UsageError(f"--out {out}: exists, valid: a new file")
        if real_path(out.parent) != real_path(self.network.parent):
            raise UsageError(f"--out {out}: valid: a file beside '{self.network}', which the card names")
        network, asked = self._network()
        try:
            found = draft(network, self.description)
            found.missing += asked
            write_atomic(out, found.text().encode())
        except BaseException:
            if network != self.network:
                network.unlink(missing_ok=True)  # made a moment ago, for this card
            raise
        print(out)
        for text in found.missing:
            print(f"missing: {text}")

    def _network(self) -> tuple[Path, list[str]]:
        """The ONNX file, made of a checkpoint if that is what was given; and what must then be asked for."""
        if self.network.suffix not in (".pt", ".pth"):
            return self.network, []
        from wbc_bench.files import write_atomic
        from wbc_bench.policies.state_dict import onnx_of, read_perceptron

        made = self.network.with_suffix(".onnx")
        if made.exists():
            raise UsageError(f"'{made}' exists, valid: a checkpoint beside which there is none")
        found = read_perceptron(self.network)
        write_atomic(made, onnx_of(found, self.activation))
        print(made)
        asked = [f"the activation between the layers: {self.activation} was taken, see --activation"]
        if found.mean is None:
            asked.append(
                "whether observations are normalised: the checkpoint has no mean and deviation of them"
            )
        if found.others:
            asked.append(
                f"whether the policy needs other networks of the checkpoint: {', '.join(found.others)}"
            )
        return made, asked


@dataclass(frozen=True)
class PolicyTerms:
    """List the observation terms that a card may name."""

    def run(self) -> None:
        print_table(term_table())


def term_table() -> "Table":
    """The vocabulary of observation terms, as the guide shows it."""
    from wbc_bench.policies.terms import FRAMES, TERMS
    from wbc_bench.results.table import Table

    rows = [
        (
            *(f"`{name}`", "" if term.size is None else str(term.size), term.unit, term.text),
            *(", ".join(FRAMES[term.kind]) if len(FRAMES[term.kind]) > 1 else "", ", ".join(term.signals)),
        )
        for name, term in TERMS.items()
    ]
    header = ("Term", "Size", "Unit", "Content", "Frames", "Reads")
    return Table("terms", "Observation terms of a policy card", header, tuple(rows))


@dataclass(frozen=True)
class PolicyCheck:
    """Print how a card reads its policy, try it for 2 s, and name the likely fault if it does not stand."""

    card: Positional[Path]
    """Path of the card, CARD.toml."""
    search: FlagCreatePairsOff[bool] = True
    """Try cards that differ in one thing if this one does not stand."""

    def run(self) -> None:
        from wbc_bench.evaluation.policy_check import check_policy

        verdict = check_policy(self.card, search=self.search)
        for table in _tables(verdict):
            print_table(table)
        for line in _symmetry(verdict):
            print(line)
        trial = verdict.trial
        print(
            f"trial of 2 s: upright {trial.upright:.0%} of the time, at its end "
            f"{100 * trial.position_error:.1f} cm and {trial.orientation_error:.2f} rad from the target"
        )
        if verdict.edit is not None and verdict.edited is not None:
            better = verdict.edited
            print(
                f"likely fault: {verdict.edit.fault}; with {verdict.edit.remedy}: "
                f"upright {better.upright:.0%}, {100 * better.position_error:.1f} cm "
                f"and {better.orientation_error:.2f} rad"
            )
        else:
            print("no fault found" if verdict.good else "no single change makes it clearly better")


def _tables(verdict: "Verdict"):
    from wbc_bench.results.table import Table
    from wbc_bench.robot import JOINT_NAMES

    card, controller = verdict.card, verdict.controller
    rows = []
    for network in controller.networks:
        for name, width in network.widths.items():
            given = network.card.inputs.get(name, "itself")
            given = given if isinstance(given, str) else " + ".join(given)
            rows.append((network.card.file, name, str(width), given))
    yield Table("networks", "Inputs of the networks", ("File", "Input", "Numbers", "From"), tuple(rows))
    rows = []
    for group in controller.groups:
        mean, std = verdict.normalizers.get(group.name, (None, None))
        for k, (term, label) in enumerate(group.labels()):
            cells = (
                "" if values is None or k >= len(values) else f"{values[k]:.3g}"
                for values in (mean, std, verdict.first[group.name])
            )
            rows.append((group.name, str(k), term, label, *cells))
    header = ("Observation", "Index", "Term", "Element", "Normaliser's mean", "Its deviation", "At the start")
    yield Table("observation", "What the policy reads", header, tuple(rows))
    driven = list(controller.driven)
    rows = [
        (
            *(str(driven.index(k)) if k in driven else card.action.others, name),
            *(f"{values[k]:g}" for values in (controller.default_q, *controller.gains)),
            f"{controller.scale[driven.index(k)]:g}" if k in driven else "",
        )
        for k, name in enumerate(JOINT_NAMES)
    ]
    header = ("Action", "Joint", "Default (rad)", "kp (N m/rad)", "kd (N m s/rad)", "Scale")
    yield Table("joints", f"What '{card.name}' commands", header, tuple(rows))


def _symmetry(verdict: "Verdict"):
    for text, values in verdict.symmetry.items():
        orders = ", ".join(f"{value:.3f} {order}" for order, value in values.items())
        yield f"left-right asymmetry of the normaliser's mean of {text}, by order of joints: {orders}"
