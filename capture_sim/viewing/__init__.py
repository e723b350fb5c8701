"""Plots, rerun recordings, reports and live views of runs."""
