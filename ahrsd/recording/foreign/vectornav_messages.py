"""Definitions of vectornav_msgs (ROS 2), which recordings in SQLite do not bring along."""

from __future__ import annotations

_INS_STATUS = """\
uint8 mode
bool gps_fix
bool time_error
bool imu_error
bool mag_pres_error
bool gps_error
bool gps_heading_ins
bool gps_compass
"""
_COMMON_GROUP = """\
std_msgs/Header header
uint16 group_fields
uint64 timestartup
uint64 timegps
uint64 timesyncin
geometry_msgs/Vector3 yawpitchroll
geometry_msgs/Quaternion quaternion
geometry_msgs/Vector3 angularrate
geometry_msgs/Point position
geometry_msgs/Vector3 velocity
geometry_msgs/Vector3 accel
geometry_msgs/Vector3 imu_accel
geometry_msgs/Vector3 imu_rate
geometry_msgs/Vector3 magpres_mag
float32 magpres_temp
float32 magpres_pres
float32 deltatheta_dtime
geometry_msgs/Vector3 deltatheta_dtheta
geometry_msgs/Vector3 deltatheta_dvel
vectornav_msgs/InsStatus insstatus
uint32 syncincnt
uint16 timegpspps
"""
_IMU_GROUP = """\
std_msgs/Header header
uint16 group_fields
uint16 imustatus
geometry_msgs/Vector3 uncompmag
geometry_msgs/Vector3 uncompaccel
geometry_msgs/Vector3 uncompgyro
float32 temp
float32 pres
float32 deltatheta_time
geometry_msgs/Vector3 deltatheta_dtheta
geometry_msgs/Vector3 deltavel
geometry_msgs/Vector3 mag
geometry_msgs/Vector3 accel
geometry_msgs/Vector3 angularrate
uint16 sensat
"""
#: message name -> its definition
DEFINITIONS = {
    "InsStatus": _INS_STATUS,
    "CommonGroup": _COMMON_GROUP,
    "ImuGroup": _IMU_GROUP,
}
