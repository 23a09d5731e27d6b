"""Device drivers: bytes on a wire to device units with arrival times. No maps, poses or configuration files here.

The contracts between a driver and the daemon are :mod:`hal.lidar`, :mod:`hal.adc`, :mod:`hal.odometry` and
:mod:`hal.imu`; errors are in :mod:`hal.errors`, time in :mod:`hal.clock`. The packages:

* ``net``: sockets, receive timestamps, odometry and IMU datagrams. ``port``: byte ports. ``bus``: I2C buses.
* ``hokuyo``: the lidar driver. ``photodiode``: the driver of the light receiver's converter.
* ``registry``: lidar drivers by name. ``replay``: recorded logs as devices. ``fake``: simulated devices.

Modules are imported by name and only where they are used: a robot without I2C loads no I2C code.
"""
