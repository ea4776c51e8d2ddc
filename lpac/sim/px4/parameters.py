"""The PX4 parameters that the simulated vehicle has, with the defaults of v1.17; units as PX4's.

An `int` value is an INT32 parameter, a `float` value a REAL32 one.
"""

PARAMETERS: dict[str, int | float] = {
    # Arming and disarming
    "COM_DISARM_LAND": 2.0,  # s after landing; 0 or less: never
    "COM_DISARM_PRFLT": 10.0,  # s armed without taking off; 0 or less: never
    "COM_SPOOLUP_TIME": 1.0,
    # Offboard, remote control, ground station
    "COM_OF_LOSS_T": 1.0,
    "COM_OBL_RC_ACT": 0,  # 0-2 a manual mode, 3 return, 4 land, 5 hold, 6 terminate, 7 disarm
    "COM_FAIL_ACT_T": 5.0,
    "COM_POS_LOW_ACT": 3,  # not acted on
    "COM_ACT_FAIL_ACT": 0,  # not acted on
    "COM_IMB_PROP_ACT": 0,  # not acted on
    "NAV_TRAFF_AVOID": 1,  # not acted on
    "COM_WIND_MAX_ACT": 0,  # not acted on
    "COM_FLTT_LOW_ACT": 0,  # not acted on
    "COM_FLT_TIME_MAX": -1,  # not acted on
    "COM_RC_IN_MODE": 3,  # 4: no manual control at all
    "COM_RC_OVERRIDE": 1,  # bit 0: sticks leave automatic modes, bit 1: offboard
    "COM_RCL_EXCEPT": 0,  # bit 1 hold, bit 2 offboard
    "NAV_RCL_ACT": 2,  # 0 none, 1 hold, 2 return, 3 land, 5 terminate, 6 disarm
    "NAV_DLL_ACT": 0,  # 0 none, 1 hold, 2 return, 3 land, 5 terminate, 6 disarm
    "COM_DL_LOSS_T": 10,
    "COM_RC_LOSS_T": 0.5,
    # Battery
    "COM_LOW_BAT_ACT": 0,  # 0 warn, 2 land when critical, 3 return when critical, then land
    "BAT_LOW_THR": 0.15,
    "BAT_CRIT_THR": 0.07,
    "BAT_EMERGEN_THR": 0.05,
    # Fence
    "GF_ACTION": 2,  # 0 none, 1 warn, 2 hold, 3 return, 4 terminate, 5 land
    "GF_MAX_HOR_DIST": 0.0,  # from home; 0: off
    "GF_MAX_VER_DIST": 0.0,
    # Motion
    "MIS_TAKEOFF_ALT": 2.5,
    "MPC_TKO_SPEED": 1.5,
    "MPC_TKO_RAMP_T": 3.0,
    "MPC_LAND_SPEED": 0.7,
    "MPC_XY_CRUISE": 5.0,
    "MPC_XY_P": 0.95,
    "MPC_Z_P": 1.0,
    "MPC_XY_VEL_MAX": 12.0,
    "MPC_Z_VEL_MAX_UP": 3.0,
    "MPC_Z_VEL_MAX_DN": 1.5,
    "MPC_ACC_HOR": 3.0,
    "MPC_ACC_UP_MAX": 4.0,
    "MPC_ACC_DOWN_MAX": 3.0,
    "RTL_RETURN_ALT": 30.0,
    # Kept for clients to read; the simulated vehicle does not act on them.
    "CBRK_FLIGHTTERM": 121212,
    "EKF2_HGT_REF": 1,
    "EKF2_GPS_CTRL": 7,  # bits: 0 place, 1 height, 2 velocity; 0: without the receiver
    "MAV_SYS_ID": 1,
    "MAV_TYPE": 2,
    "SYS_AUTOSTART": 10040,
}
