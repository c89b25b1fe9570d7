"""The state of Gymnasium environments as plain values, so that a run that was killed goes on in the middle of an episode."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch


def taken(env) -> dict[str, Any]:
    """Where an environment is: a MuJoCo task's or Pendulum's state, the steps of its time limit, its random numbers."""
    base = env.unwrapped
    state = _mujoco_state(base) if hasattr(base, "data") else np.array(base.state, dtype=float)
    return {
        "state": torch.from_numpy(state.copy()),
        "elapsed": env.get_wrapper_attr("_elapsed_steps"),
        "random": _plain(base.np_random.bit_generator.state),
    }


def restored(env, snapshot) -> None:
    """Put an environment of the same kind where `taken` found it."""
    env.reset()
    base, state = env.unwrapped, snapshot["state"].numpy()
    if hasattr(base, "data"):
        import mujoco

        mujoco.mj_setState(base.model, base.data, state, mujoco.mjtState.mjSTATE_INTEGRATION)
        mujoco.mj_forward(base.model, base.data)
        mujoco.mj_setState(base.model, base.data, state, mujoco.mjtState.mjSTATE_INTEGRATION)  # forward changes the warm start
    else:
        base.state = state
    env.set_wrapper_attr("_elapsed_steps", snapshot["elapsed"])
    base.np_random.bit_generator.state = snapshot["random"]


def _mujoco_state(base) -> np.ndarray:
    import mujoco

    state = np.empty(mujoco.mj_stateSize(base.model, mujoco.mjtState.mjSTATE_INTEGRATION))
    mujoco.mj_getState(base.model, base.data, state, mujoco.mjtState.mjSTATE_INTEGRATION)
    return state


def _plain(value: Any) -> Any:
    """A generator's state without NumPy's own types, which a checkpoint does not hold."""
    if isinstance(value, dict):
        return {name: _plain(entry) for name, entry in value.items()}
    return value.item() if isinstance(value, np.generic) else value
