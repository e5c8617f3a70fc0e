"""The pure core: values and decisions. No clock, threads, I/O or third-party library."""
