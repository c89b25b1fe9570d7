"""Agents that write: language models, preferences, judges of text, reward models, and fine-tuning."""
