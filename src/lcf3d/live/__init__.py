"""The fusion on a stream: synchronisation, latency, health, a watch over calibration and time; ROS 2."""
