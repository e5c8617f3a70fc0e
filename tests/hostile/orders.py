"""What a hostile replica is told, without what it needs: `tests.hostile.serve` obeys it."""

HOSTILE = "FOGFT_HOSTILE"  # names the file with its orders
CLAIMED = "/robot/emergency_stop"
ESCAPES = "\x1b]0;3 of 3 ready\x07\x1b[2J"
