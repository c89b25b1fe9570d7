"""From a folder of submissions to verdicts: intake, the sandbox, and the judge that trusts nothing in it."""
