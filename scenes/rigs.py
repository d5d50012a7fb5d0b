"""Rigs of three radars on the drives of simulated scenes."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from radarsdf.simulate import MountedRadar, RadarSensor, SimulatedRig, Simulation, simulate_rig
from scipy.spatial.transform import Rotation

FRAME_S = 0.1
"""Time between the poses of a simulated scene, s."""

_RADARS = {
    # Yaw, roll and pitch of the mounting, deg, lever arm, m, azimuth field of view, rad, gain, dB, noise, rate, Hz.
    "front": ((0.0, 0.0, 2.0), (1.8, 0.1, -0.3), np.deg2rad(70), 0.0, 1.0, 10.0),
    "rear": ((178.0, 1.0, 0.0), (-1.5, -0.2, 0.1), np.deg2rad(70), -6.0, 2.0, 13.0),
    "side": ((95.0, 0.0, -3.0), (0.2, 0.7, 0.4), np.deg2rad(140), 4.0, 1.0, 20.0),
}


def three_radars(sensor: RadarSensor) -> dict[str, MountedRadar]:
    """Mount three variants of a radar: front and rear narrow, side wide, each with its own gain, noise and rate.

    Together they have about as many beams a second as the radar itself at 10 Hz has in 0.2 s.
    """
    mounted = {}
    for label, (yaw_roll_pitch_deg, lever_m, fov_rad, gain_db, noise, rate_hz) in _RADARS.items():
        share = 20.0 / (3 * rate_hz)
        own = replace(
            sensor,
            azimuth_fov_rad=fov_rad,
            beams=max(1, round(share * sensor.beams)),
            sigma_range_m=noise * sensor.sigma_range_m,
            sigma_range_per_m=noise * sensor.sigma_range_per_m,
            sigma_azimuth_rad=noise * sensor.sigma_azimuth_rad,
            sigma_elevation_rad=noise * sensor.sigma_elevation_rad,
            gain_db=sensor.gain_db + gain_db,
            threshold_db=sensor.threshold_db + gain_db,
            saturation_db=sensor.saturation_db + gain_db,
            floor_db=None if sensor.floor_db is None else sensor.floor_db + gain_db,
            clutter_per_scan=share * sensor.clutter_per_scan,
            phantoms_per_scan=share * sensor.phantoms_per_scan,
        )
        T_body_sensor = np.eye(4)
        T_body_sensor[:3, :3] = Rotation.from_euler("ZXY", yaw_roll_pitch_deg, degrees=True).as_matrix()
        T_body_sensor[:3, 3] = lever_m
        mounted[label] = MountedRadar(own, T_body_sensor, rate_hz)
    return mounted


def drive_of_rig(
    simulation: Simulation, labels: Sequence[str] = tuple(_RADARS), seed: int = 0
) -> SimulatedRig:
    """Repeat a drive with those of the three radars named by `labels`, variants of its own radar."""
    radars = three_radars(simulation.sensor)
    times_s = FRAME_S * np.arange(len(simulation))
    return simulate_rig(
        simulation.scene, {label: radars[label] for label in labels}, simulation.poses, times_s, seed=seed
    )
