"""The command line: arguments in, text out.

Not here: what a command does (`fogft.pool.commands`).
"""
