/* SPDX-FileCopyrightText: 2026 The koopman_ros Authors
 * SPDX-License-Identifier: Apache-2.0
 *
 * The controller in the loop of a timer: start, missing sample, missed period, manual mode, stop.
 * Replace the functions board_... by those of the board; here they simulate one, whose sensors
 * stay at the nominal point.
 */
#include "controller.h"

#include <math.h>
#include <stddef.h>
#include <stdio.h>

static int64_t board_time_ns;
static double board_outputs[CONTROLLER_NU];

/* A monotonic clock, from any time on */
static int64_t board_clock_ns(void)
{
    return board_time_ns;
}

/* Wait for the next period; period 6 ends late, so that one is missed. */
static void board_wait(int period)
{
    board_time_ns += (period == 6 ? 2 : 1) * (int64_t)CONTROLLER_PERIOD_NS;
}

/* Read the sensors; returns 0 without a new sample, here in the periods 1, 9 and 10. */
static int board_read(int period, double *measured)
{
    static const double nominal[CONTROLLER_NY] = {@NOMINAL@};
    for (int i = 0; i < CONTROLLER_NY; i++) {
        measured[i] = nominal[i];
    }
    return period != 1 && period != 9 && period != 10;
}

/* The operator's switch to manual mode, here from period 13 to 15 */
static int board_is_manual(int period)
{
    return period >= 13 && period <= 15;
}

/* Write the actuators, and restart the watchdog: if it ends, it writes the safe input. */
static void board_write(const double *command)
{
    for (int i = 0; i < CONTROLLER_NU; i++) {
        board_outputs[i] = command[i];
    }
}

int main(void)
{
    static controller_state state;
    static controller_inputs inputs;
    static controller_outputs outputs;
    double safe[CONTROLLER_NU];
    int64_t last_ns = board_clock_ns();
    int automatic = 0;

    for (int i = 0; i < CONTROLLER_NC; i++) {
        inputs.setpoint[i] = (double)NAN;       /* no request: the first measurement stays */
    }
    for (int i = 0; i < CONTROLLER_NU; i++) {
        inputs.applied[i] = (double)NAN;        /* the actuators report nothing */
    }
#if ND
    for (int i = 0; i < CONTROLLER_ND; i++) {
        inputs.disturbance[i] = (double)NAN;    /* its sensor reports nothing: nominal */
    }
#endif
    for (int period = 1; period <= 20; period++) {
        int64_t now_ns;
        board_wait(period);
        now_ns = board_clock_ns();
        if (board_is_manual(period)) {
            automatic = 0;                      /* the operator writes the actuators */
            continue;
        }
        if (!automatic) {
            /* at the start the inputs are unknown; after manual mode they are the operator's */
            controller_init(&state, period == 1 ? NULL : board_outputs);
            automatic = 1;
        }
        inputs.elapsed_ns = now_ns - last_ns;   /* a missed period makes it longer */
        last_ns = now_ns;
        inputs.received = board_read(period, inputs.measured);
        controller_step(&state, &inputs, &outputs);
        board_write(outputs.command);
        printf("%d: level %d, status %d", period, outputs.level, outputs.status);
        for (int i = 0; i < CONTROLLER_NU; i++) {
            printf(", %.6g", outputs.command[i]);
        }
        printf("\n");
    }
    controller_safe_input(safe);                /* stop */
    board_write(safe);
    return 0;
}
