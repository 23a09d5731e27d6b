"""CDMA receiver (Sect. 2): ADC sample blocks to `LightEpoch`, the decoded lamps and their RSS."""
