"""The experiment of chapter 51's planner: it is the page's program, bit for bit, and its rows are horizons."""

import pytest
import torch

from autograder.authoring import chapter
from experiments import planning
from solutions import ch51

TINY = planning.SETTINGS.but(members=2, elites=1, model_hidden=8, patience=1)


@pytest.fixture
def tiny(monkeypatch):
    monkeypatch.setattr(planning, "SETTINGS", TINY)


def test_the_page_shows_the_program_that_was_recorded(tiny):
    (cell,) = [cell for cell in chapter.load("ch51").cells if cell.kind == "code" and "def swing_up" in cell.source]
    page = dict(vars(ch51))
    exec(cell.source.partition("swing = ")[0], page)
    assert (page["SETTINGS"], page["best_plan"].__defaults__) == (planning.mbpo.MBPOSettings().but(model_hidden=64), (100, 5, 4))
    page["SETTINGS"] = TINY
    returns, models, obs, actions = page["swing_up"](3, episodes=3)
    recorded, _, everything = planning.swing_up(3, lambda done, total: None, episodes=3)
    recorded_obs, recorded_actions = planning.episode_of(everything)
    assert returns == recorded and len(models) == 2
    assert torch.equal(obs, recorded_obs) and torch.equal(actions, recorded_actions)


def test_rows_are_horizons_and_the_summary_has_each_return(tiny, tmp_path, monkeypatch):
    swing_up = planning.swing_up
    monkeypatch.setattr(planning, "swing_up", lambda *given, cap: swing_up(*given, episodes=2, cap=cap))
    told = []
    result = planning.run("swing_up", 0, tmp_path, lambda done, total: told.append((done, total)))
    assert [row["horizon"] for row in result.rows] == list(range(1, 51))
    assert set(result.rows[0]) == {"horizon", "still", "error_200", "mean_200"}
    assert result.rows[0]["still"] < result.rows[19]["still"]
    assert len(result.summary["returns"]) == len(result.summary["upper"]) == 2 and told == [(1, 2), (2, 2)]
    assert all(0 <= share <= 1 for share in result.summary["upper"]) and isinstance(result.summary["promised"], float)


def test_variants_change_how_far_is_planned_and_nothing_else(tiny, tmp_path, monkeypatch):
    lengths = {name: given["pieces"] * given["hold"] for name, given in planning.VARIANTS.items()}
    far = {"plan_40": 40, "plan_40_held": 40}
    assert lengths == {"swing_up": 20, "plan_4": 4, "plan_8": 8, "plan_12": 12, "capped": 20} | far
    for name, given in planning.VARIANTS.items():
        assert given | {"pieces": 5, "hold": 4} == planning.VARIANTS["swing_up"] | ({"capped": True} if name == "capped" else {})
    asked = []

    def best_plan(model, obs, generator, **planner):
        asked.append(planner)
        return torch.zeros(planning.CARRIED_OUT, 1)

    monkeypatch.setattr(planning, "best_plan", best_plan)
    planning.run("plan_40", 0, tmp_path, lambda done, total: None)
    assert asked == [{"candidates": 100, "pieces": 10, "hold": 4}] * 300


def test_a_capped_planner_expects_no_reward_above_the_highest_that_it_has_earned(tiny, monkeypatch):
    def promising(obs, actions, generator):
        return obs, torch.tensor([-5.0, -1.0, 3.0]), torch.ones(3)

    assert planning.capped(promising, -2.0)(None, None, None)[1].tolist() == [-5.0, -2.0, -2.0]
    asked = []

    def best_plan(model, obs, generator, **planner):
        asked.append(model(torch.as_tensor(obs)[None], torch.zeros(1, 1), generator)[1].item())
        return torch.zeros(planning.CARRIED_OUT, 1)

    monkeypatch.setattr(planning, "best_plan", best_plan)
    monkeypatch.setattr(
        planning.mbpo.Ensemble, "__call__", lambda self, obs, actions, generator: (obs, torch.ones(1), torch.ones(1))
    )
    _, _, everything = planning.swing_up(0, lambda done, total: None, episodes=2, cap=True)
    assert set(asked) == {everything.rewards[:200].max().item()}
