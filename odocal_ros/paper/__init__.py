"""The tables and error model of Shi et al. 2015, computed."""
