# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Messages for tests, made with rosbags' own types: random ones and the sensors of a drive."""

from functools import lru_cache

import numpy as np
from rosbags.typesys import get_typestore, Stores


@lru_cache
def store():
    return get_typestore(Stores.ROS2_JAZZY)


def kind(msgtype):
    return store().types[msgtype]


def cdr(message, little_endian=True):
    return bytes(store().serialize_cdr(message, message.__msgtype__, little_endian=little_endian))


def deserializer(msgtype):
    """Return the function for one type that readers use."""
    return lambda raw: store().deserialize_cdr(raw, msgtype)


def header(stamp_ns=0, frame='imu_link'):
    time = kind('builtin_interfaces/msg/Time')(sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    return kind('std_msgs/msg/Header')(stamp=time, frame_id=frame)


def stamped(msgtype, stamp_ns, frame, **content):
    return kind(msgtype)(header=header(stamp_ns, frame), **content)


def vector(x=0.0, y=0.0, z=0.0):
    return kind('geometry_msgs/msg/Vector3')(x=float(x), y=float(y), z=float(z))


def quaternion(x=0.0, y=0.0, z=0.0, w=1.0):
    return kind('geometry_msgs/msg/Quaternion')(x=float(x), y=float(y), z=float(z), w=float(w))


def imu(stamp_ns, w=(0, 0, 0), f=(0, 0, 9.81), q=(0, 0, 0, 1), covariance=None, frame='imu_link'):
    """Return a sensor_msgs/Imu; covariance None: no orientation, by REP-145."""
    none = np.zeros(9)
    first = np.array([-1.0] + [0.0] * 8) if covariance is None else np.array(covariance, float)
    return stamped(
        'sensor_msgs/msg/Imu', stamp_ns, frame,
        orientation=quaternion(*q), orientation_covariance=first,
        angular_velocity=vector(*w), angular_velocity_covariance=none,
        linear_acceleration=vector(*f), linear_acceleration_covariance=none)


def fix(stamp_ns, latitude, longitude, altitude=0.0, sigma=1.0, status=0, known=2):
    return stamped(
        'sensor_msgs/msg/NavSatFix', stamp_ns, 'gps',
        status=kind('sensor_msgs/msg/NavSatStatus')(status=status, service=1),
        latitude=float(latitude), longitude=float(longitude), altitude=float(altitude),
        position_covariance=np.diag([sigma**2, sigma**2, 4 * sigma**2]).reshape(9),
        position_covariance_type=known)


def whole(value, name='Int64'):
    return kind(f'std_msgs/msg/{name}')(data=value)


def real(value, name='Float64'):
    return kind(f'std_msgs/msg/{name}')(data=float(value))


def whole_array(values, name='Int32', labels=()):
    dims = [kind('std_msgs/msg/MultiArrayDimension')(label=text, size=1, stride=1)
            for text in labels]
    layout = kind('std_msgs/msg/MultiArrayLayout')(dim=dims, data_offset=0)
    return kind(f'std_msgs/msg/{name}MultiArray')(
        layout=layout, data=np.array(values, np.int32 if name == 'Int32' else np.int64))


def joints(stamp_ns, names, position=(), velocity=(), effort=(), frame=''):
    return stamped(
        'sensor_msgs/msg/JointState', stamp_ns, frame, name=list(names),
        position=np.array(position, float), velocity=np.array(velocity, float),
        effort=np.array(effort, float))


def twist(x, y=0.0, z=0.0):
    return kind('geometry_msgs/msg/Twist')(linear=vector(x, y, z), angular=vector(0, 0, 0.5))


def twist_stamped(stamp_ns, x, y=0.0, z=0.0, frame='base_link'):
    return stamped('geometry_msgs/msg/TwistStamped', stamp_ns, frame, twist=twist(x, y, z))


def twist_covariance(stamp_ns, x, y=0.0, z=0.0, variances=(0.0, 0.0, 0.0), frame='base_link'):
    covariance = np.zeros((6, 6))
    covariance[[0, 1, 2], [0, 1, 2]] = variances
    inner = kind('geometry_msgs/msg/TwistWithCovariance')(twist=twist(x, y, z),
                                                          covariance=covariance.reshape(36))
    return stamped('geometry_msgs/msg/TwistWithCovarianceStamped', stamp_ns, frame, twist=inner)


def pose_at(position):
    point = kind('geometry_msgs/msg/Point')(**dict(zip('xyz', map(float, position), strict=True)))
    return kind('geometry_msgs/msg/Pose')(position=point, orientation=quaternion())


def pose(stamp_ns, position, frame='map'):
    return stamped('geometry_msgs/msg/PoseStamped', stamp_ns, frame, pose=pose_at(position))


def pose_covariance(stamp_ns, position, covariance, frame='map'):
    """Return a geometry_msgs/PoseWithCovarianceStamped; covariance: (6, 6)."""
    inner = kind('geometry_msgs/msg/PoseWithCovariance')(
        pose=pose_at(position), covariance=np.array(covariance, float).reshape(36))
    return stamped('geometry_msgs/msg/PoseWithCovarianceStamped', stamp_ns, frame, pose=inner)


def point(stamp_ns, position, frame='map'):
    return stamped('geometry_msgs/msg/PointStamped', stamp_ns, frame,
                   point=pose_at(position).position)


def transform(stamp_ns, position, child='robot', frame='world'):
    inner = kind('geometry_msgs/msg/Transform')(translation=vector(*position),
                                                rotation=quaternion())
    return stamped('geometry_msgs/msg/TransformStamped', stamp_ns, frame, child_frame_id=child,
                   transform=inner)


def odometry(stamp_ns, x, child='base_link', frame='odom'):
    inner = kind('geometry_msgs/msg/PoseWithCovariance')(pose=pose_at((1.0, 2.0, 3.0)),
                                                         covariance=np.arange(36.0))
    moves = kind('geometry_msgs/msg/TwistWithCovariance')(twist=twist(x), covariance=np.zeros(36))
    return stamped('nav_msgs/msg/Odometry', stamp_ns, frame, child_frame_id=child, pose=inner,
                   twist=moves)
