"""What a page shows: plots, explorers, videos, and the records of long runs with their statistics."""
