"""Every figure the documentation states, each with the code that measures it: ``python -m benchmarks [NAME …]``."""
