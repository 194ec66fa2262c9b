"""Measurements of triform, beside its peers and the limits of the machine: ``python -m benchmarks``, or ``make bench``.

Every group of rows is a module with a ``measure`` function that yields rows; ``groups.GROUPS`` names them. What is
compared is timed in turns inside one run (``timing``), so that other work on the machine slows both sides.
"""
