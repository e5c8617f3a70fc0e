"""Graphical output: the full-screen view, the HTML report and the plot of a plan.

Not here: tables and lines of text (`fogft.cli.status_text`, `fogft.cli.table`).
"""
