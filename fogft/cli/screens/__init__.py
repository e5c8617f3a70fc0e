"""The full-screen view, a report, a plan plotted. Not here: tables (`fogft.cli.table`)."""
