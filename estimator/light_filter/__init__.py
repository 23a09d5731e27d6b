"""Lamp model and light EKF (Sect. 2-3, Eq. 1-7): `LightEpoch` to the light pose (T1)."""
