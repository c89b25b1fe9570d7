"""What judges a function: cases, observing a call, comparing with what is right, and the client that the notebook and the shell use."""
