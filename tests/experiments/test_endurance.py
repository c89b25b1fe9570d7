"""The longer runs of SAC: the published settings of walker's runs, but for the number of steps, on three tasks."""

from experiments import control, endurance, walker


def test_only_the_number_of_steps_differs_from_the_shorter_runs():
    shorter, longer = walker.VARIANTS["published"], endurance.VARIANTS["sac_walker2d"]
    assert longer["total_steps"] == 300_000 > shorter["total_steps"]
    assert longer | {"total_steps": shorter["total_steps"]} == shorter


def test_the_three_tasks_have_the_same_settings():
    longer = endurance.VARIANTS["sac_walker2d"]
    for variant, other in endurance.VARIANTS.items():
        assert other | {"environment": longer["environment"]} == longer
        assert other["environment"] == control.ENVIRONMENTS[variant.removeprefix("sac_")]


def test_a_run_goes_the_way_of_the_shorter_one_for_as_long_as_that_lasts(monkeypatch, tmp_path):
    small = {"learning_starts": 60, "hidden": 8}
    choice = endurance.CHOICE | {"batch_size": 16, "updates_from": 30}
    monkeypatch.setattr(endurance, "CHOICE", choice)
    monkeypatch.setitem(walker.CHOICES, "published", choice)
    monkeypatch.setitem(control.SAC_SETTINGS, "walker2d", control.SAC_SETTINGS["walker2d"].but(total_steps=120, **small))
    longer = walker.settings("walker2d", choice).but(total_steps=180)
    monkeypatch.setitem(endurance.SETTINGS, "sac_walker2d", longer)
    rows = {}
    for module, variant in ((walker, "published"), (endurance, "sac_walker2d")):
        monkeypatch.setitem(module.VARIANTS, variant, module.VARIANTS[variant] | {"every": 60})
        folder = tmp_path / module.__name__
        folder.mkdir()
        rows[module] = [row["eval_return"] for row in module.run(variant, 2, folder, lambda done, total: None).rows]
    assert len(rows[walker]) == 3 and rows[endurance][:3] == rows[walker]
    assert len(set(rows[endurance])) > 1
