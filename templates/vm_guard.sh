#!/bin/sh
# Run by a VM on AWS at each boot, beside all that SkyPilot does: where no replica is seen for
# so long, nobody may be left to end this machine, so it shuts itself down. SkyPilot's own `autostop`
# begins only when the machine is wholly set up. What runs in a container is seen from here, too.
[ "${1:-}" = stay ] || { setsid "$0" stay >/dev/null 2>&1 & exit; }  # a boot waits for its scripts
alone=0
while [ "$alone" -lt @ALONE_MINUTES@ ]; do
  sleep 60
  alone=$((alone + 1))
  # The brackets keep this line's own grep from being taken for a replica.
  if cat /proc/[0-9]*/cmdline 2>/dev/null | tr '\0' ' ' | grep -q 'fogft[ ]serve'; then alone=0; fi
done
shutdown -h now || poweroff -f
