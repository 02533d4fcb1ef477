/* SPDX-FileCopyrightText: 2026 The koopman_ros Authors
 * SPDX-License-Identifier: Apache-2.0
 *
 * Test of vectors: reads calls from standard input, as the rows of test_vectors.csv, and prints
 * each answer. A row that has the answer of the Python controller, too, is compared with it.
 * Returns 0, 1 where a command or a level differs, 2 for a text that is no such row.
 */
#include "controller.h"

#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define TOLERANCE 1e-5      /* relative, of a command outside the training data; else 1e-9 */

/* Read n numbers that are separated by commas; returns the text behind, or NULL. */
static const char *read_numbers(const char *text, int n, double *to)
{
    for (int i = 0; text && i < n; i++) {
        char *end;
        to[i] = strtod(text, &end);
        if (end == text || (*end != ',' && *end != '\0')) {
            text = NULL;
        } else if (*end == ',') {
            text = end + 1;
        } else {
            text = i < n - 1 ? NULL : end;
        }
    }
    return text;
}

/* Read the inputs of a call, and an answer if there is one; returns 0 for another text. */
static int read_row(const char *text, controller_inputs *inputs, double *answer, int *compare)
{
    char *end;
    double received;
    errno = 0;
    inputs->elapsed_ns = (int64_t)strtoll(text, &end, 10);
    if (end == text || *end != ',' || errno != 0) {
        return 0;
    }
    text = read_numbers(end + 1, 1, &received);
    inputs->received = received > 0.0;
    text = read_numbers(text, CONTROLLER_NY, inputs->measured);
    text = read_numbers(text, CONTROLLER_NC, inputs->setpoint);
    text = read_numbers(text, CONTROLLER_NU, inputs->applied);
#if ND
    text = read_numbers(text, CONTROLLER_ND, inputs->disturbance);
#endif
    *compare = text && *text != '\0';
    if (*compare) {
        text = read_numbers(text, CONTROLLER_NU + 3, answer);
    }
    return text && *text == '\0' && text[-1] != ',';
}

int main(void)
{
    static controller_state state;
    static controller_inputs inputs;
    static controller_outputs outputs;
    static char line[4096];
    double answer[CONTROLLER_NU + 3], worst = 0.0;
    int compare, compared = 0, differ = 0;

    controller_init(&state, NULL);
    for (int row = 1; fgets(line, sizeof line, stdin); row++) {
        size_t length = strcspn(line, "\r\n");
        int whole = line[length] != '\0' || feof(stdin);
        line[length] = '\0';
        if (row == 1 && strncmp(line, "elapsed_ns,", 11) == 0) {
            continue;                   /* the header */
        }
        if (!whole || !read_row(line, &inputs, answer, &compare)) {
            fprintf(stderr, "row %d is not a call: %.60s\n", row, line);
            return 2;
        }
        controller_step(&state, &inputs, &outputs);
        for (int i = 0; i < CONTROLLER_NU; i++) {
            printf("%.17g,", outputs.command[i]);
            if (compare) {
                double error = fabs(outputs.command[i] - answer[i]) / (1e-3 + fabs(answer[i]));
                worst = error > worst ? error : worst;
                differ += !(error <= TOLERANCE);
            }
        }
        printf("%d,%d,%d\n", outputs.level, outputs.status, outputs.cause);
        fflush(stdout);                 /* an answer before the next call */
        compared += compare;
        differ += compare && (int)answer[CONTROLLER_NU] != outputs.level;
    }
    if (compared > 0) {
        fprintf(stderr, "%d calls compared, %d differ, largest relative error %.1e\n", compared,
                differ, worst);
    }
    return differ > 0;
}
