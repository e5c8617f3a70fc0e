# Builds the colcon workspace in the working folder: the `setup` of a replica whose pool file has
# none and whose `workdir` has packages in `src`. What is built already is not built again.
for ros in /opt/ros/*/setup.bash; do [ ! -f "$ros" ] || . "$ros"; done
if [ -f install/setup.sh ] && ! grep -qF "$PWD/install" install/setup.sh; then
  rm -rf build install  # it came along from the machine that built it
fi
[ ! -f build/COLCON_IGNORE ] || grep -qsF "=$PWD/" build/*/CMakeCache.txt || rm -rf build
if [ -f install/setup.sh ] && [ -z "$(find src -newer install/setup.sh -print -quit)" ]; then
  exit 0
fi
command -v colcon >/dev/null || {
  echo "fogft: colcon is missing: name an image that has it, or give the pool file a setup" >&2
  exit 1
}
options=-DBUILD_TESTING=OFF
if [ -z "${ROS_DISTRO:-}" ] && python3 -c 'import fogft.ros.wheels' 2>/dev/null; then
  # ROS 2 from wheels: what builds against it has to be told which Python this is.
  prefix=$(python3 -m fogft.ros.wheels "$PWD/build/ros-wheels") || exit 1
  export AMENT_PREFIX_PATH=$prefix CMAKE_PREFIX_PATH=$prefix
  options="$options -DPython3_EXECUTABLE=$(command -v python3)"
fi
# shellcheck disable=SC2086  # options are words
colcon --log-base build/log build --base-paths src --cmake-args $options
