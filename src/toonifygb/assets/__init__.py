"""Things we did not make: where model files come from, under which licence, and how they become ours to read."""
