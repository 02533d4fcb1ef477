/* SPDX-FileCopyrightText: 2026 The koopman_ros Authors
 * SPDX-License-Identifier: Apache-2.0
 *
 * Start on QEMU's mps2-an386, and a wrapper that measures each step: with -icount shift=0 an
 * instruction takes 1 ns, and the timer counts at 25 MHz.
 */
#include "controller.h"

#include <stdio.h>

#define STACK 131072
#define TIMER ((volatile uint32_t *)0xE000E010u)

extern void _start(void);
extern void __real_controller_step(controller_state *, const controller_inputs *,
                                   controller_outputs *);
void __wrap_controller_step(controller_state *, const controller_inputs *, controller_outputs *);

static void reset(void)
{
    *(volatile uint32_t *)0xE000ED88u |= 0xFu << 20; /* switch the floating-point unit on */
    TIMER[1] = 0xFFFFFFu;
    TIMER[0] = 5;
    _start();
}

__attribute__((section(".vectors"), used)) static void (*const vectors[])(void) = {
    (void (*)(void))0x003FF000u, reset};

void __wrap_controller_step(controller_state *s, const controller_inputs *in,
                            controller_outputs *out)
{
    static uint32_t most, deepest;
    uint32_t mark, count, deep;
    volatile uint32_t *top = (volatile uint32_t *)(uintptr_t)&mark, *below = top - STACK / 4;
    for (volatile uint32_t *p = below; p < top - 64; p++) *p = 0xA5A5A5A5u;
    mark = TIMER[2];
    __real_controller_step(s, in, out);
    count = ((mark - TIMER[2]) & 0xFFFFFFu) * 40u;
    while (*below == 0xA5A5A5A5u) below++;
    deep = (uint32_t)(top - below) * 4u;
    most = count > most ? count : most;
    deepest = deep > deepest ? deep : deepest;
    fprintf(stderr, "%lu %lu %lu\n", (unsigned long)most, (unsigned long)deepest,
            (unsigned long)sizeof *s);
}
