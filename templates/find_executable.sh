find_executable() {  # prints the path of an executable of a ROS package
  local prefix
  IFS=: read -ra prefixes <<<"${AMENT_PREFIX_PATH:-}"
  for prefix in "${prefixes[@]}"; do
    if [ -x "$prefix/lib/$1/$2" ]; then echo "$prefix/lib/$1/$2"; return; fi
  done
  echo "error: package \`$1\` has no executable \`$2\` here (AMENT_PREFIX_PATH is \
${AMENT_PREFIX_PATH:-empty}); build or install it in \`setup\`" >&2
  return 127
}
