/* Reads calls from standard input, as the rows of test_vectors.csv, and prints each answer. */
#include "controller.h"

#include <stdio.h>
#include <stdlib.h>

static void numbers(char **text, int n, double *to)
{
    for (int i = 0; i < n; i++) {
        to[i] = strtod(*text, text);
        if (**text == ',') ++*text;
    }
}

int main(void)
{
    static koopman_state state;
    static koopman_inputs inputs;
    koopman_outputs outputs;
    char line[4096], *text;
    double start[2];

    koopman_init(&state, NULL);
    while (fgets(line, sizeof line, stdin)) {
        text = line;
        if (line[0] < '0' || line[0] > '9') continue; /* the header */
        numbers(&text, 2, start);
        inputs.elapsed_ns = (int64_t)start[0];
        inputs.received = start[1] > 0.0;
        numbers(&text, KOOPMAN_NY, inputs.measured);
        numbers(&text, KOOPMAN_NC, inputs.setpoint);
        numbers(&text, KOOPMAN_NU, inputs.applied);
        numbers(&text, KOOPMAN_ND, inputs.disturbance);
        koopman_step(&state, &inputs, &outputs);
        for (int i = 0; i < KOOPMAN_NU; i++) printf("%.17g,", outputs.command[i]);
        printf("%d,%d,%d\n", outputs.level, outputs.status, outputs.cause);
        fflush(stdout); /* an answer before the next call */
    }
    return 0;
}
