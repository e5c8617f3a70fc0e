"""The full-screen view, the HTML report and the plot of a plan. Not here: `fogft.cli.table`."""
