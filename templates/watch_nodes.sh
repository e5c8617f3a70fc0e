# Not `wait -n`: bash forgets a child that ended before it was called.
while :; do
  for node in "${nodes[@]}"; do
    if ! kill -0 "$node" 2>/dev/null; then
      wait "$node"; status=$?
      kill "${nodes[@]}" 2>/dev/null
      wait
      exit $status
    fi
  done
  sleep 0.5
done
