"""What other libraries compute on one input, beside the course: the input, a script for each library, and their records."""
