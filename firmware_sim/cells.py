"""Where a bank of drives keeps what: the columns of its two tables, one row a drive.

The names are those of `firmware_sim.drive.Drive`; what is a constant of the drive stands here as well, so that a row
says all that the compiled code needs.
"""

# float64
(
    Q,
    QD,
    ZERO,
    TEMPERATURE,
    TORQUE,
    STRENGTH,
    SLEW,
    SLEW_BOUND,
    SLEW_BUDGET,
    OVER_SPEED,
    COMMAND_P,
    COMMAND_V,
    COMMAND_KP,
    COMMAND_KD,
    COMMAND_T,
    SCALE_P,
    SCALE_V,
    SCALE_T,
    RATED,  # [Nm] rating.torque
    LARGEST,  # [Nm] largest |torque| at the end of a period so far
    FLOATS,
) = range(21)

# int64
(
    STATE,
    FAULT,
    WATCHDOG_TRIPPED,
    BRAKE,
    RELEASE_NS,
    FLAGS,
    SILENCE_NS,
    FAULT_AGE_NS,
    UPTIME_NS,
    LAST_VALID_NS,
    TIMEOUT_NS,
    COUNTER_IN,
    COUNTER_OUT,
    REJECTED,
    MOTOR,
    REPLY_ID,
    RELEASE_AFTER_NS,  # rating.release_ns
    COMMANDED,  # a frame on the drive's id came in this period
    RESTLESS,  # 1 while the newest trip waits to see the joint at rest
    TRIP_AT,  # of the newest trip, written together with the event TRIPPED
    TRIP_VALID,
    EVENT,  # what Python must write down of this drive: bits TRIPPED, RESTED
    INTS,
) = range(23)

TRIPPED, RESTED = 1, 2
