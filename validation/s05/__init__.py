"""The figures of R. Sim, P. Elinas, M. Griffin and J. Little (2005), made again in the simulated laboratory."""
