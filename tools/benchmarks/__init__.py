"""Benchmarks of gripmon: ``tools/bench NAME``.  One module a benchmark; nothing here is part of the product."""
