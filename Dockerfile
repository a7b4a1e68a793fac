# Two images of odocal_ros. Recorded bags only (Python, no ROS):
#   docker build --target offline -t odocal:offline .
#   docker run --rm -u "$(id -u):$(id -g)" -v "$PWD:/bags" odocal:offline try my_bag
# With the live node (the default target), on ROS 2 Jazzy; --build-arg ROS_DISTRO=kilted for Kilted:
#   docker build -t odocal:ros .
#   docker run --rm --net=host --ipc=host odocal:ros calibrator
ARG ROS_DISTRO=jazzy

FROM python:3.12-slim AS offline
COPY . /src
RUN pip install --no-cache-dir /src && rm -rf /src
# any user may be given with -u
ENV HOME=/tmp MPLCONFIGDIR=/tmp/matplotlib
WORKDIR /bags
ENTRYPOINT ["odocal"]
CMD ["--help"]

FROM ros:${ROS_DISTRO} AS ros
SHELL ["/bin/bash", "-o", "pipefail", "-c"]
COPY . /ws/src/odocal_ros
WORKDIR /ws
# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install -y --no-install-recommends python3-pip python3-rich \
    && rosdep update --rosdistro "$ROS_DISTRO" \
    && rosdep install --from-paths src --ignore-src -y \
    && rm -rf /var/lib/apt/lists/*
# rosbag1 files and message types that are no standard ones
RUN pip install --no-cache-dir --break-system-packages 'rosbags>=0.11,<0.12'
RUN source "/opt/ros/$ROS_DISTRO/setup.bash" && colcon build --packages-select odocal_ros
ENV PATH=/ws/install/odocal_ros/lib/odocal_ros:$PATH
WORKDIR /bags
ENTRYPOINT ["/bin/bash", "-c", "source /ws/install/setup.bash && exec \"$0\" \"$@\""]
CMD ["calibrator"]
