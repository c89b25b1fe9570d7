"""`python -m autograder`, the same as `course`."""

from autograder.cli import main

main()
