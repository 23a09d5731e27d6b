"""Simulated devices that match the wire protocol, with encoders of their own, fault injection and an injected clock.

``lidar`` is a HOKUYO sensor, ``transport`` carries its bytes, ``adc`` is the photodiode's converter on its I2C bus,
``odometry`` a motor controller, ``faults`` the fault orders for all of them. No module here imports a driver's codec.
"""
