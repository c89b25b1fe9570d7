"""What readers, learners and teachers get: the book, the bundle, and a course for plain nbgrader."""
