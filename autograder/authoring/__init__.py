"""What a chapter is made of: its text, the contract with its reference, the views of it, and the parts of its checks."""
