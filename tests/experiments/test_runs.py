"""The committed records: of experiments that exist, whole, of the configuration that the code has now, and small."""

from course_lib.figures import records
from experiments import runner


def test_committed_records_are_finished_and_small():
    folders = [folder for folder in runner.RUNS.glob("[!.]*") if folder.is_dir()]
    assert {folder.name for folder in folders} <= set(runner.names())
    for folder in folders:
        module = runner.definition(folder.name)
        for run in records.load(folder.name, runner.RUNS).runs:
            task = runner.Task(module.__file__, run.variant, run.seed, str(runner.RUNS), "")
            assert runner.state(task) == "finished", run.path
    assert sum(path.stat().st_size for folder in folders for path in folder.iterdir()) < 20e6
