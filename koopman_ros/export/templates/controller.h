/* SPDX-FileCopyrightText: 2026 The koopman_ros Authors
 * SPDX-License-Identifier: Apache-2.0
 *
@ABOUT@
 */
#ifndef KOOPMAN_CONTROLLER_H
#define KOOPMAN_CONTROLLER_H

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

@SIZES@

/* The control level that acts; the levels of the laws are numbered from the best one, 0. */
enum {
    KOOPMAN_HOLD = KOOPMAN_LAWS, KOOPMAN_SAFE
};

enum {
@CODES@
};

/* Signals are in the order of the lists above and in their units. */
typedef struct {
    int64_t elapsed_ns;                 /* since the call before; does not count at the first */
    int received;                       /* 0: there is no new measurement */
    double measured[KOOPMAN_NY];
    double setpoint[KOOPMAN_NC];        /* NAN: no request, the one before stays */
    double applied[KOOPMAN_NU];         /* measured inputs; NAN: not measured */
    double disturbance[KOOPMAN_ND];     /* measured disturbances; NAN: the one before stays */
} koopman_inputs;

typedef struct {
    double command[KOOPMAN_NU];         /* finite, and within range and rate limit */
    int level;
    int status, cause;                  /* why no better level acts, and the reason behind that */
    int setpoint_rejected;               /* 1: outside the trained range, the one before stays */
    double state[KOOPMAN_NX];           /* estimated; NAN before the first measurement */
    double setpoint[KOOPMAN_NC];        /* active, on its ramp; NAN before the first measurement */
} koopman_outputs;

/* All that is remembered from one call to the next; none of it is to be changed. */
typedef struct {
    int level, resumes, status, cause;
    int64_t bad_since, better_since;
} koopman_supervisor;

typedef struct {
    int known;
    double x[KOOPMAN_NX], w[KOOPMAN_NX], P[KOOPMAN_NP * KOOPMAN_NP];
} koopman_estimate;

typedef struct {
    int64_t now, measured_at, commanded_at;
    int commanded, law, jumped, active, transferring;
    double interval, command[KOOPMAN_NU];
    int queued;
    int64_t applied_at[KOOPMAN_QUEUE];
    double applied[KOOPMAN_QUEUE][KOOPMAN_NU];
    double requested[KOOPMAN_NC], setpoint[KOOPMAN_NC], ramped[KOOPMAN_NC];
    int64_t accepted_at, still_since[KOOPMAN_NY], seen_since[KOOPMAN_NY];
    int unmeasured[KOOPMAN_ND];
    int64_t disturbed_at[KOOPMAN_ND];
    double disturbance[KOOPMAN_ND];
    double accepted[KOOPMAN_NY], travel[KOOPMAN_NY], resolution[KOOPMAN_NY], still_w[KOOPMAN_NX];
    koopman_estimate estimate;
    koopman_supervisor supervisor;
    int recovering, led;
    double farthest, nearest;
    int64_t resting_since;
    double offset[KOOPMAN_NU], feed[KOOPMAN_NU];
    double target[KOOPMAN_NX + KOOPMAN_NU];
} koopman_state;

/* Start; applied (KOOPMAN_NU) are the inputs that act already, or NULL where they are unknown. */
void koopman_init(koopman_state *state, const double *applied);

/* Find the command; state is used and renewed. Without a command so far it is the safe input. */
void koopman_step(koopman_state *state, const koopman_inputs *inputs, koopman_outputs *outputs);

#ifdef __cplusplus
}
#endif

#endif
