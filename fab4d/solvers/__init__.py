"""Linear and nonlinear solvers that know arrays and callables only."""
