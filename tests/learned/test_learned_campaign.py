"""A campaign: one recipe from random weights to all methods and seeds."""

from pathlib import Path

import pytest

pytest.importorskip("torch")
pytest.importorskip("rsl_rl")

from wbc_baselines.learned.policy import checkpoint
from wbc_baselines.learned.policy.methods import METHODS
from wbc_baselines.learned.training.campaign import campaign, runs_of, standing
from wbc_baselines.learned.training.cli import main
from wbc_baselines.learned.training.curves import write_curves
from wbc_baselines.learned.training.recipe import find_recipe, recipe_names
from wbc_baselines.learned.training.run_folder import RunFolder
from wbc_bench.errors import BenchError, UnknownNameError

TINY_RECIPE = """
name = "tiny"
[common]
budget = 48
num_envs = 8
num_steps_per_env = 6
num_mini_batches = 2
threads = 1
estimator_share = 0.5
estimator_mini_batches = 2
posture_loss = [0, 0]
arm_ik_loss = [0, 0]
std_legs = [[0, 0.4], [40, 0.2]]
[from_scratch]
critic_warmup_iterations = 0
[distilled]
distillation_steps = 24
kickstart_steps = 48
"""


def recipe_file(folder: Path, text: str = TINY_RECIPE) -> str:
    path = folder / "tiny.toml"
    path.write_text(text)
    return str(path)


def test_a_campaign_trains_what_is_missing_each_seed_from_its_own_oracle(tmp_path):
    """Every method and seed once; what is done, claimed elsewhere or without its oracle is left alone."""
    recipe = find_recipe(recipe_file(tmp_path))
    chosen = runs_of(recipe, ["no_latent"], 2, tmp_path)
    assert [one.name for one in chosen] == ["oracle@0", "no_latent@0", "oracle@1", "no_latent@1"]
    for oracle, student in zip(chosen[::2], chosen[1::2], strict=True):
        assert (oracle.init_checkpoint, oracle.teacher, oracle.critic_warmup_iterations) == ("", "", 0)
        path = str(tmp_path / oracle.name / f"{oracle.name}.safetensors")
        assert student.init_checkpoint == student.teacher == path
        assert student.distillation_steps == 24 and student.std_legs == ((0, 0.4), (40, 0.2))
    elsewhere = RunFolder(tmp_path / "oracle@0")
    assert elsewhere.take()
    names = [one.name for one in campaign(chosen, tmp_path, lambda *_: None)]
    assert names == ["oracle@1", "no_latent@1"]
    elsewhere.release()
    assert [one.name for one in campaign(chosen, tmp_path, lambda *_: None)] == ["oracle@0", "no_latent@0"]
    found = standing(tmp_path)
    assert [(s.name, s.state, s.samples) for s in found] == [
        (name, "done", 48) for name in ("no_latent@0", "no_latent@1", "oracle@0", "oracle@1")
    ]
    card = checkpoint.load(tmp_path / "no_latent@1" / "no_latent@1.safetensors").card
    oracle = checkpoint.load(tmp_path / "oracle@1" / "oracle@1.safetensors").card
    assert card.teacher == card.init_checkpoint == f"oracle@1 {oracle.sha256}"
    figures = write_curves(tmp_path, tmp_path / "figures")
    assert {path.suffix for path in figures} == {".png", ".svg"}
    assert figures[0].read_bytes()[:4] == b"\x89PNG"


def test_a_campaign_from_scratch_has_no_teacher(tmp_path):
    """And from the command line: PPO alone, from random weights."""
    words = ["campaign", "--recipe", recipe_file(tmp_path), "--methods", "no_latent", "--seeds", "1"]
    main([*words, "--from-scratch", "--threads", "1", "--out", str(tmp_path / "runs")])
    folders = [path.name for path in (tmp_path / "runs").iterdir()]
    assert folders == ["no_latent@0"]
    card = checkpoint.load(tmp_path / "runs/no_latent@0/no_latent@0.safetensors").card
    assert card.teacher == card.init_checkpoint == ""


def test_the_recipes_of_the_package_can_be_run(tmp_path):
    for name in recipe_names():
        runs = runs_of(find_recipe(name), list(METHODS), 3, tmp_path)
        assert len(runs) == 3 * len(METHODS)
        for run in runs:  # what an oracle begins with is there
            if run.method == "oracle" and run.init_checkpoint:
                checkpoint.load_init_checkpoint(run.init_checkpoint, "oracle", robot="paper")


def test_an_oracle_may_begin_with_one_of_another_robot(tmp_path):
    found = checkpoint.load_init_checkpoint("limx_adapter/oracle@0", "oracle", robot="paper")
    assert found.card.method == "oracle"
    with pytest.raises(UnknownNameError, match=r"'oracle@7'"):
        checkpoint.load_init_checkpoint("limx_adapter/oracle@7", "oracle", robot="paper")


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ("budget = 48", "bugdet = 48", r"unknown setting 'bugdet' .*did you mean budget"),
        ("budget = 48", 'method = "gru"', "unknown setting 'method'"),
        ("budget = 48", 'budget = "much"', r"recipe 'tiny': Expected `float`, got `str` - at `\$\.budget`"),
        ("budget = 48", "budget = 0", r"--budget 0\.?0?: valid: 1 or more"),
        ("[[0, 0.4], [40, 0.2]]", "[[9, 0.4], [4, 0.2]]", "--std-legs 9 0.4 4 0.2: valid: control steps"),
        ("[common]", "[commons]", "unknown field `commons`"),
        ('name = "tiny"', "name = [", r"recipe .*tiny\.toml: Invalid value"),
    ],
)
def test_a_recipe_that_cannot_be_is_refused_in_one_line(before, after, message, tmp_path):
    assert before in TINY_RECIPE
    path = recipe_file(tmp_path, TINY_RECIPE.replace(before, after))
    with pytest.raises(BenchError, match=message):
        runs_of(find_recipe(path), ["no_latent"], 1, tmp_path)


def test_an_unknown_recipe_names_those_there_are():
    with pytest.raises(UnknownNameError, match=r"unknown recipe 'papr'.*did you mean paper"):
        find_recipe("papr")
