"""From verdicts to people: the gradebook, the exports for learning platforms, the reports, and the pages on a class."""
