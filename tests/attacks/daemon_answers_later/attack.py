"""A right answer to the first exercise leaves a daemon that answers the last one, for which the notebook has nothing right. The
daemon knows no more than the learner, and confusing the conversation only loses points."""

from pathlib import Path

from nbformat import NotebookNode

from tests.attacks.toolbox import CHANNEL, answer, last, write, wrong

BODY = """
import os, time
if os.fork() == 0:
    os.setsid()
    time.sleep(0.3)
    for _ in range(20):
        channel.send({"observations": [{"kind": "tuple of 2"}] * 40, "score": 2.0, "state": "correct"})
    os._exit(0)
validate.same_shape(rewards=rewards, values=values, next_values=next_values, terminated=terminated)
validate.unit_interval(gamma=gamma)
return (rewards + gamma * next_values * ~terminated - values).detach()
"""


def make(folder: Path, notebook: NotebookNode) -> None:
    answer(notebook, "td_residuals", BODY)
    wrong(notebook)
    last(notebook, CHANNEL)
    write(folder, notebook)
