"""From and to learning platforms: collecting what they hand out, giving back what was graded, and listing work that is alike."""
