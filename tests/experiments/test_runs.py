"""The committed records: of experiments that exist, whole, of the configuration that the code has now, and small."""

from course_lib.figures import records
from experiments import campaign


def test_committed_records_are_finished_and_small():
    folders = [folder for folder in campaign.RUNS.glob("[!.]*") if folder.is_dir()]
    assert {folder.name for folder in folders} <= set(campaign.names())
    for folder in folders:
        module = campaign.definition(folder.name)
        for run in records.load(folder.name, campaign.RUNS).runs:
            task = campaign.Task(module.__file__, run.variant, run.seed, str(campaign.RUNS), "")
            assert campaign.state(task) == "finished", run.path
    assert sum(path.stat().st_size for folder in folders for path in folder.iterdir()) < 20e6
