"""A table of steps."""


def table(done, results):
    return "".join(f"{b - a:7.1f} s  {n}\n" for n, a, b in done)
