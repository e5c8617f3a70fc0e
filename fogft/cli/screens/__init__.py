"""What is looked at rather than read: a full screen, a page, a plot.

Not here: tables and lines of text (`fogft.cli.status_text`, `fogft.cli.table`).
"""
