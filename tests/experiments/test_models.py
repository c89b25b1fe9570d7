"""The experiment of chapter 51: its variants, its rows, its film, and that a run goes on where it was stopped."""

import numpy as np
import pytest
import torch

from experiments import checkpoint, control, models

TINY = models.PENDULUM.but(
    total_steps=60, learning_starts=20, batch_size=16, hidden=8, updates=1, refresh_every=20, imagined_steps=40, imagined_size=40,
    members=2, elites=1, model_hidden=8, patience=1,
)  # fmt: skip


@pytest.fixture
def tiny(monkeypatch):
    monkeypatch.setitem(models.SETTINGS, "pendulum", TINY)
    monkeypatch.setitem(models.EVERY, "pendulum", 20)
    monkeypatch.setitem(models.CHUNK, "pendulum", 10)
    monkeypatch.setattr(models, "TRAJECTORIES", 2)
    monkeypatch.setattr(control, "EPISODES", 1)


def timeless(rows):
    return [{name: value for name, value in row.items() if "seconds" not in name} for row in rows]


def test_variants_of_pendulum_change_one_setting_each():
    for variant, configuration in models.VARIANTS.items():
        if variant.startswith("pendulum_"):
            changed = [name for name, value in configuration.items() if value != models.VARIANTS["pendulum"][name]]
            assert len(changed) == (variant != "pendulum_film"), variant


def test_rows_have_returns_and_errors_once_there_is_a_model(tiny, tmp_path):
    result = models.run("pendulum", 0, tmp_path, lambda done, total: None)
    assert [row["env_steps"] for row in result.rows] == [0, 20, 40, 60]
    assert all(row["eval_return"] < 0 for row in result.rows)
    assert ["error_20" in row for row in result.rows] == [False, False, True, True]
    assert result.rows[-1]["still_1"] > 0 and len(result.summary["final_returns"]) == 10


def test_a_stopped_run_goes_on_with_the_same_numbers(tiny, tmp_path, monkeypatch):
    whole = models.run("pendulum", 1, tmp_path / "whole", lambda done, total: None)
    monkeypatch.setattr(control, "SAVE_EVERY", 0.0)
    (tmp_path / "stopped").mkdir()

    def stop(done, total):
        if done == 50 and checkpoint.load(tmp_path / "stopped"):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        models.run("pendulum", 1, tmp_path / "stopped", stop)
    resumed = models.run("pendulum", 1, tmp_path / "stopped", lambda done, total: None)
    np.testing.assert_equal(timeless(resumed.rows), timeless(whole.rows))
    assert resumed.summary["final_returns"] == whole.summary["final_returns"]


def test_trajectories_that_end_are_left_out():
    made = models.MBPORun("walker2d", 0)
    obs, actions = models.trajectories(made.training.agent, "Walker2d-v5", 3, torch.Generator().manual_seed(0))
    assert obs.shape[0] == 4 and actions.shape[0] == 3 and obs.shape[1] == actions.shape[1] > 0
    none, _ = models.trajectories(made.training.agent, "Walker2d-v5", 400, torch.Generator().manual_seed(0))
    assert none.shape[1] == 0


def test_a_pendulum_is_drawn_where_its_observation_says():
    upright, left = torch.tensor([[1.0, 0.0, 0.0]]), torch.tensor([[0.0, 1.0, 0.0]])
    (frame,) = models.filmed([upright, left], ("one", "other"))
    assert frame.shape == (models.SIZE, 2 * models.SIZE, 3)
    rod = np.argwhere((frame[:, : models.SIZE] == (0x2A, 0x7F, 0xBF)).all(-1))
    assert rod[:, 0].max() - rod[:, 0].min() > 60 > 20 > rod[:, 1].max() - rod[:, 1].min()
    rod = np.argwhere((frame[:, models.SIZE :] == (0xD5, 0x5E, 0x00)).all(-1))
    assert rod[:, 1].min() < models.SIZE * 0.2 and rod[:, 1].max() < models.SIZE * 0.6
