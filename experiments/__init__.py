"""Long runs: a module for each experiment, the engine that makes them (`course experiment`), and their records in runs/."""
