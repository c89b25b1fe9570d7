"""What learners import: checks, environments, rollouts, plotting. Holds no answers and imports nothing else of the project."""

from course_lib.chapters import earlier
from course_lib.checks.client import check

__all__ = ["check", "earlier"]
