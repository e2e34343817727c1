"""Emulators: the sensors of a simulated robot, speaking their devices' protocols over real ports, with faults."""
