"""The longer runs of SAC: the settings of control's runs, but for the number of steps."""

from experiments import control, endurance


def test_only_the_number_of_steps_differs_from_the_shorter_runs():
    for variant, longer in endurance.VARIANTS.items():
        shorter = control.VARIANTS[variant]
        assert longer["total_steps"] == 300_000 > shorter["total_steps"]
        assert longer | {"total_steps": shorter["total_steps"]} == shorter


def test_a_run_goes_the_way_of_the_shorter_one_for_as_long_as_that_lasts(monkeypatch, tmp_path):
    small = {"learning_starts": 60, "batch_size": 16, "hidden": 8}
    monkeypatch.setitem(control.SAC_SETTINGS, "hopper", control.SAC_SETTINGS["hopper"].but(total_steps=120, **small))
    monkeypatch.setitem(endurance.SETTINGS, "sac_hopper", endurance.SETTINGS["sac_hopper"].but(total_steps=180, **small))
    rows = {}
    for module in (control, endurance):
        monkeypatch.setitem(module.VARIANTS, "sac_hopper", module.VARIANTS["sac_hopper"] | {"every": 60})
        folder = tmp_path / module.__name__
        folder.mkdir()
        rows[module] = [row["eval_return"] for row in module.run("sac_hopper", 2, folder, lambda done, total: None).rows]
    assert len(rows[control]) == 3 and rows[endurance][:3] == rows[control]
