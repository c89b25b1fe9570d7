"""`python -m course_lib.check NOTEBOOK.ipynb`. Only run, never imported: `course_lib.check` is the function of that name."""

import sys

from course_lib.checks.command import main

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
