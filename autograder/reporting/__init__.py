"""From verdicts to people: the gradebook, the exports for learning platforms, and the reports."""
