"""What the paper reports, to stand beside our own numbers."""

from __future__ import annotations

#: Table I: share of 100 simulated runs that succeed, by number of robots.
SUCCESS = {5: 1.00, 7: 0.99, 9: 0.99, 11: 0.99, 13: 1.00}
#: Fig. 4: median formation error; it lies in this range for every number of robots.
MEDIAN_ERROR = (0.05, 0.07)
#: Fig. 4: median converge time [s], about the same for every number of robots.
CONVERGE_TIME = 7.0
#: Experiments with real robots: their number, median formation error and median converge time [s].
REAL_ROBOTS = 4
REAL_MEDIAN_ERROR = 0.09
REAL_CONVERGE_TIME = 14.0
