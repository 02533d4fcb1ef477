/* SPDX-FileCopyrightText: 2026 The koopman_ros Authors
 * SPDX-License-Identifier: Apache-2.0
 *
@ABOUT@
 */
#ifndef CONTROLLER_H
#define CONTROLLER_H

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/* Numbers of states, inputs, measured signals, set-points and measured disturbances; size of a
 * covariance; laws; inputs under way that are kept; shortest time between two calls */
@SIZES@

/* The control level that acts; the levels of the laws are numbered from the best one, 0. */
enum {
    CONTROLLER_HOLD = CONTROLLER_LAWS, CONTROLLER_SAFE
};

enum {
@CODES@
};

/* Signals are in the order of the lists above and in their units. */
typedef struct {
    int64_t elapsed_ns;     /* since the last call; below 0 counts as 0, above 73 years as these */
    int received;           /* 0: there is no new measurement */
    double measured[CONTROLLER_NY];
    double setpoint[CONTROLLER_NC];     /* NAN: no request, the one before stays */
    double applied[CONTROLLER_NU];      /* measured inputs; NAN: not measured */
#if ND
    double disturbance[CONTROLLER_ND];  /* measured disturbances; NAN: the one before stays */
#endif
} controller_inputs;

typedef struct {
    /* finite, within range, and within the rate limit of the command before or of the inputs at
     * the start */
    double command[CONTROLLER_NU];
    int level;
    int status, cause;      /* why no better level acts, and the reason behind that */
    int setpoint_rejected;  /* 1: outside the trained range, the one before stays */
    double state[CONTROLLER_NX];        /* estimated; NAN before the first measurement */
    double setpoint[CONTROLLER_NC];     /* on its ramp; NAN before the first measurement */
} controller_outputs;

/* All that is remembered from one call to the next; none of it is to be changed. */
typedef struct {
    int level, resumes, status, cause;
    int64_t bad_since, better_since;
} controller_supervisor;

typedef struct {
    int known;
    double x[CONTROLLER_NX], w[CONTROLLER_NX];
#if KALMAN
    double P[CONTROLLER_NP * CONTROLLER_NP];
#endif
} controller_estimate;

typedef struct {
    int64_t measured_at, commanded_at;  /* times are in ns, relative to the last call */
    int commanded, law, jumped, active, transferring;
    double interval, command[CONTROLLER_NU];
    int queued;
    int64_t applied_at[CONTROLLER_QUEUE];
    double applied[CONTROLLER_QUEUE][CONTROLLER_NU];
    double requested[CONTROLLER_NC], setpoint[CONTROLLER_NC], ramped[CONTROLLER_NC];
    int64_t accepted_at, still_since[CONTROLLER_NY], seen_since[CONTROLLER_NY];
#if ND
    int unmeasured[CONTROLLER_ND];
    int64_t disturbed_at[CONTROLLER_ND];
    double disturbance[CONTROLLER_ND];
#endif
    double accepted[CONTROLLER_NY], travel[CONTROLLER_NY], resolution[CONTROLLER_NY];
    double still_w[CONTROLLER_NX];
    controller_estimate estimate;
    controller_supervisor supervisor;
    int recovering, led;
    double farthest, nearest;
    int64_t resting_since;
#if BUMPLESS
    double offset[CONTROLLER_NU], feed[CONTROLLER_NU];
#endif
    double target[CONTROLLER_NX + CONTROLLER_NU];
} controller_state;

/* Start; applied (CONTROLLER_NU) are the inputs that act already. With NULL they are unknown:
 * calls before the first measurement are answered by the safe input. */
void controller_init(controller_state *state, const double *applied);

/* Find the command; state is used and renewed. */
void controller_step(controller_state *state, const controller_inputs *inputs,
                     controller_outputs *outputs);

/* The safe input (CONTROLLER_NU), for a watchdog and a stop */
void controller_safe_input(double *command);

#ifdef __cplusplus
}
#endif

#endif
