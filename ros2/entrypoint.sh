# runs a command with ROS 2 and the workspace of the node
set -e
. /opt/ros/jazzy/setup.bash
. /opt/ws/install/setup.bash
exec "$@"
