"""Agents that act: environments, policies, rollouts, PPO, SAC, and models of the world."""
