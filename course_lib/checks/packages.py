"""What is there when a notebook is graded, beside Python and course_lib: one list for the sandbox, the bundle's README and the book."""

LEARNER_PACKAGES = (
    "torch",
    "numpy",
    "scipy",
    "matplotlib",
    "ipython",
    "ipywidgets",
    "gymnasium[box2d,mujoco]",
    "pyarrow",
    "safetensors",
    "threadpoolctl",
    "tqdm",
    "transformers",
    "vaderSentiment",
)
"""What a learner may import. Their requirements come with them; nothing else that is installed does."""


def listed() -> str:
    """The packages in words."""
    names = [name.partition("[")[0] for name in LEARNER_PACKAGES]
    return f"{', '.join(names[:-1])} and {names[-1]}"
