/* SPDX-FileCopyrightText: 2026 The koopman_ros Authors
 * SPDX-License-Identifier: Apache-2.0
 *
@ABOUT@
 */
#include "controller.h"

#include <math.h>
#include <stddef.h>

@TABLES@

#define NX KOOPMAN_NX
#define NU KOOPMAN_NU
#define NY KOOPMAN_NY
#define NC KOOPMAN_NC
#define NP KOOPMAN_NP
#define LAWS KOOPMAN_LAWS
#define NXU (NX + NU)
#define NR (CLOSED ? NZ : NX)           /* order of the Riccati equation */
#define NN (NR + NU)
#define MOST (NZ > NXU ? NZ : NXU)
#define OF_X NX, X_CENTER, X_SCALE
#define OF_U NU, U_CENTER, U_SCALE
#define NEVER INT64_MIN
#define SECOND 1e9
#define EACH(i, n) for (int i = 0; i < (n); i++)

/* Matrices are arrays by rows. */

static double larger(double a, double b) { return isnan(a) || a > b ? a : b; }

static double smaller(double a, double b) { return isnan(a) || a < b ? a : b; }

static void copy(int n, const double *from, double *to) { EACH(i, n) to[i] = from[i]; }

static void fill(int n, double value, double *to) { EACH(i, n) to[i] = value; }

/* y = y + f x */
static void add(int n, double f, const double *x, double *y) { EACH(i, n) y[i] += f * x[i]; }

static double dot(int n, const double *x, const double *y) {
    double sum = 0.0;
    EACH(i, n) sum += x[i] * y[i];
    return sum;
}

static double size_of(int n, const double *x) { return sqrt(dot(n, x, x)); }

static int finite(int n, const double *x) {
    EACH(i, n) if (!isfinite(x[i])) return 0;
    return 1;
}

/* Copy a block (m, n) of a matrix with rows of `from_width` to one with rows of `to_width`. */
static void block(int m, int n, int from_width, const double *from, int to_width, double *to) {
    EACH(i, m) copy(n, from + i * from_width, to + i * to_width);
}

static void diagonal(int n, double value, double *A) {
    fill(n * n, 0.0, A);
    EACH(i, n) A[i * n + i] = value;
}

static void transpose(int m, int n, const double *A, double *At) {
    EACH(i, m) EACH(j, n) At[j * m + i] = A[i * n + j];
}

static void symmetric(int n, double *A) {
    EACH(i, n) EACH(j, i) A[i * n + j] = A[j * n + i] = 0.5 * (A[i * n + j] + A[j * n + i]);
}

/* C (m, n) = C + f A B of A (m, k), B (k, n) */
static void plus(double f, int m, int k, int n, const double *A, const double *B, double *C) {
    EACH(i, m) EACH(l, k) add(n, f * A[i * k + l], B + l * n, C + i * n);
}

/* C (m, n) = C + f A' B of A (k, m), B (k, n) */
static void plus_turned(double f, int m, int k, int n, const double *A, const double *B, double *C)
{
    EACH(l, k) EACH(i, m) add(n, f * A[l * m + i], B + l * n, C + i * n);
}

static void mul(int m, int k, int n, const double *A, const double *B, double *C) {
    fill(m * n, 0.0, C);
    plus(1.0, m, k, n, A, B, C);
}

static void swap(int n, double *x, double *y) {
    EACH(i, n) {
        double kept = x[i];
        x[i] = y[i], y[i] = kept;
    }
}

/* B (n, m) = A^-1 B by elimination with pivots; A is used up. */
static void solve(int n, int m, double *A, double *B) {
    EACH(k, n) {
        int pivot = k;
        for (int i = k + 1; i < n; i++)
            if (fabs(A[i * n + k]) > fabs(A[pivot * n + k])) pivot = i;
        swap(n, A + k * n, A + pivot * n);
        swap(m, B + k * m, B + pivot * m);
        EACH(i, n) {
            double factor = A[i * n + k] / A[k * n + k];
            if (i == k) continue;
            add(n, -factor, A + k * n, A + i * n);
            add(m, -factor, B + k * m, B + i * m);
        }
    }
    EACH(k, n) EACH(j, m) B[k * m + j] /= A[k * n + k];
}

/* Turn rows x, y of n so that they are x c - y s and x s + y c. */
static void turn(int n, double c, double s, double *x, double *y) {
    EACH(i, n) {
        double kept = x[i];
        x[i] = c * kept - s * y[i], y[i] = s * kept + c * y[i];
    }
}

/* X (n, m) = pseudo-inverse of A (m, n), by one-sided Jacobi rotations; returns the norm of A. */
static double pseudo_inverse(int m, int n, const double *A, double *X) {
    int rows = m > n ? m : n, few = m > n ? n : m, turned = 1;
    double U[MOST * MOST], V[MOST * MOST], largest = 0.0;
    if (m >= n) transpose(m, n, A, U); else copy(m * n, A, U);
    diagonal(few, 1.0, V);
    for (int sweep = 0; turned && sweep < 30; sweep++) {
        turned = 0;
        EACH(q, few) EACH(p, q) {
            double *a = U + p * rows, *b = U + q * rows, ab = dot(rows, a, b);
            double aa = dot(rows, a, a), bb = dot(rows, b, b), zeta = (bb - aa) / (2.0 * ab);
            double t = copysign(1.0, zeta) / (fabs(zeta) + sqrt(1.0 + zeta * zeta));
            if (!(fabs(ab) > 1e-16 * sqrt(aa * bb))) continue;
            turned = 1;
            turn(rows, 1.0 / sqrt(1.0 + t * t), t / sqrt(1.0 + t * t), a, b);
            turn(few, 1.0 / sqrt(1.0 + t * t), t / sqrt(1.0 + t * t), V + p * few, V + q * few);
        }
    }
    EACH(k, few) largest = larger(largest, size_of(rows, U + k * rows));
    fill(m * n, 0.0, X);
    EACH(k, few) {
        double *u = U + k * rows, *v = V + k * few, square = dot(rows, u, u);
        if (!(sqrt(square) <= 1e-15 * largest))
            EACH(i, n) add(m, (m >= n ? v[i] : u[i]) / square, m >= n ? u : v, X + i * m);
    }
    return largest;
}

/* --- The model, in scaled deviations from the nominal point --- */

static void deviation(int n, const double *center, const double *scale, const double *value,
                      double *x) {
    EACH(i, n) x[i] = (value[i] - center[i]) / scale[i];
}

static void physical(int n, const double *center, const double *scale, const double *x,
                     double *value) {
    EACH(i, n) value[i] = center[i] + x[i] * scale[i];
}

static double apart(const double *a, const double *b) {
    double distance = 0.0;
    EACH(i, NX) distance = larger(distance, fabs((a[i] - b[i]) / HALF_WIDTH[i]));
    return distance;
}

/* Distance of a state, in its units, from the training data in half-ranges. */
static double distance(const double *state) {
    double x[NX], out = 0.0, nearest = INFINITY;
    deviation(OF_X, state, x);
    if (!finite(NX, x)) return INFINITY;
    EACH(i, NX)
        out = larger(out, larger(CORNERS[i] - x[i], x[i] - CORNERS[NX + i]) / HALF_WIDTH[i]);
    EACH(k, N_TRAINING) nearest = smaller(nearest, apart(TRAINING + k * NX, x));
    return N_TRAINING ? larger(out, nearest - FILL_DISTANCE) : out;
}

/* Whether the law failed in the tested loop nearest to a state and a set-point (NX). */
static int failed_near(const double *x, const double *x_ref) {
    double nearest[2] = {INFINITY, INFINITY};
    EACH(k, N_LOOPS) {
        double start = apart(LOOP_STARTS + k * NX, x), end = apart(LOOP_SETPOINTS + k * NX, x_ref);
        nearest[LOOP_LOST[k]] = smaller(nearest[LOOP_LOST[k]], larger(start, end));
    }
    return nearest[1] < nearest[0];
}

/* Product of the powers of x, differentiated by x_i and x_j where these are not negative. */
static double monomial(const int *powers, const double *x, int i, int j) {
    double value = 1.0;
    EACH(k, NX) {
        int power = powers[k];
        if (k == i) value *= power--;
        if (k == j) value *= power--;
        while (power-- > 0) value *= x[k];
    }
    return value;
}

/* psi = (x, phi(x)), its derivatives (N_PSI, NX), and second ones of phi (N_PHI, NX, NX). */
static void features(const double *x, double *psi, double *slope, double *bend) {
    copy(NX, x, psi);
    diagonal(NX, 1.0, slope);
    EACH(k, N_PHI) {
        const double *w = WEIGHT + k * NX;
        const int *powers = POWERS + k * NX;
        double h = NETWORK ? tanh(BIAS[k] + dot(NX, w, x)) : 0.0, s = 1.0 - h * h;
        psi[NX + k] = NETWORK ? h - AT_ZERO[k] : monomial(powers, x, -1, -1);
        EACH(i, NX) {
            slope[(NX + k) * NX + i] = NETWORK ? s * w[i] : monomial(powers, x, i, -1);
            EACH(j, NX) bend[(k * NX + i) * NX + j] =
                NETWORK ? -2.0 * h * s * w[i] * w[j] : monomial(powers, x, i, j);
        }
    }
}

static void between(const double *x_ref, const double *x, int node, double *at) {
    EACH(i, NX) at[i] = x_ref[i] + NODES[node] * (x[i] - x_ref[i]);
}

/* Secants M of psi and H of psi' w (N_PSI, NX) between two states. */
static void secants(const double *x, const double *x_ref, const double *w, double *M, double *H) {
    double psi[N_PSI], slope[N_PSI * NX], bend[N_PHI_ * NX * NX], at[NX];
    fill(N_PSI * NX, 0.0, M);
    fill(N_PSI * NX, 0.0, H);
    diagonal(NX, 1.0, M);
    EACH(k, NETWORK ? N_PHI : 0) {
        const double *v = WEIGHT + k * NX;
        double a = BIAS[k] + dot(NX, v, x), b = BIAS[k] + dot(NX, v, x_ref), h = tanh(a);
        double d = a - b + copysign(1e-300, a - b), secant = tanh(d) / d * (1.0 - h * tanh(b));
        add(NX, secant, v, M + (NX + k) * NX);
        add(NX, -(h + tanh(b)) * secant * dot(NX, v, w), v, H + (NX + k) * NX);
    }
    EACH(node, NETWORK ? 0 : 5) {
        between(x_ref, x, node, at);
        features(at, psi, slope, bend);
        add(N_PHI * NX, SHARES[node], slope + NX * NX, M + NX * NX);
        EACH(k, N_PHI * NX) H[NX * NX + k] += SHARES[node] * dot(NX, bend + k * NX, w);
    }
}

/* The drift f (NX) and its derivative J (NX, NX), of the model or of its linearisation. */
static void drift(int linear, const double *x, double *f, double *J) {
    double psi[N_PSI], slope[N_PSI * NX], bend[N_PHI_ * NX * NX], z[NZ], N[NZ * NX], rate[NZ];
    double onto[NX * NZ], AN[NZ * NX], bent[NX * NX] = {0}, square[NX * NX], by_bend[NX];
    if (linear) {
        mul(NX, NX, 1, SLOPE, x, f);
        copy(NX * NX, SLOPE, J);
        return;
    }
    features(x, psi, slope, bend);
    if (READ_OUT) {
        mul(NX, N_PSI, 1, DRIFT, psi, f);
        mul(NX, N_PSI, NX, DRIFT, slope, J);
        return;
    }
    /* f = N'^+ A N, and the derivative of N''N' f = N''A N by each state */
    mul(NZ, N_PSI, 1, LIFT, psi, z);
    mul(NZ, N_PSI, NX, LIFT, slope, N);
    pseudo_inverse(NZ, NX, N, onto);
    mul(NZ, NZ, 1, DYNAMICS, z, rate);
    mul(NX, NZ, 1, onto, rate, f);
    plus(-1.0, NZ, NX, 1, N, f, rate);
    mul(NZ, NZ, NX, DYNAMICS, N, AN);
    EACH(k, N_PHI) {
        double rest = 0.0;
        mul(NX, NX, 1, bend + k * NX * NX, f, by_bend);
        EACH(i, NZ) {
            add(NX, -LIFT[i * N_PSI + NX + k], by_bend, AN + i * NX);
            rest += LIFT[i * N_PSI + NX + k] * rate[i];
        }
        add(NX * NX, rest, bend + k * NX * NX, bent);
    }
    EACH(i, NX) EACH(j, NX) square[i * NX + j] = dot(NZ, onto + i * NZ, onto + j * NZ);
    mul(NX, NZ, NX, onto, AN, J);
    plus(1.0, NX, NX, NX, square, bent, J);
    plus(-1.0, NX, NX, 1, PRE_FEEDBACK, x, f);
    add(NX * NX, -1.0, PRE_FEEDBACK, J);
}

/* B(x) (NX, NU); where J is not NULL, also the derivative (NX, NX) of B(x) u. */
static void input_matrix(int linear, const double *x, const double *u, double *B, double *J) {
    copy(NX * NU, INPUT_MATRIX, B);
    if (J) fill(NX * NX, 0.0, J);
    EACH(k, linear ? 0 : N_TERMS) {
        const double *term = TERMS + k * NX * NU;
        add(NX * NU, monomial(TERM_POWERS + k * NX, x, -1, -1), term, B);
        EACH(i, J ? NX : 0) EACH(l, NX)
            J[i * NX + l] += dot(NU, term + i * NU, u) * monomial(TERM_POWERS + k * NX, x, l, -1);
    }
}

/* rate = f(x) + B(x) u + w, and its derivative J (NX, NX) */
static void rate_under(int linear, const double *x, const double *u, const double *w, double *rate,
                       double *J) {
    double B[NX * NU], bend[NX * NX];
    drift(linear, x, rate, J);
    input_matrix(linear, x, u, B, bend);
    plus(1.0, NX, NU, 1, B, u, rate);
    add(NX, 1.0, w, rate);
    add(NX * NX, 1.0, bend, J);
}

/* D with (B(x) - B(x_ref)) u = D (x - x_ref), and where slope is not NULL, slope = D + the mean of
 * the drift's derivative from x_ref to x, both (NX, NX) */
static void averaged(const double *x, const double *x_ref, const double *u, double *slope,
                     double *D) {
    double M[N_PSI * NX], H[N_PSI * NX], at[NX], f[NX], B[NX * NU], J[NX * NX];
    fill(NX * NX, 0.0, D);
    if (slope) fill(NX * NX, 0.0, slope);
    EACH(node, 5) {
        between(x_ref, x, node, at);
        input_matrix(0, at, u, B, J);
        add(NX * NX, SHARES[node], J, D);
        if (READ_OUT || !slope) continue;
        drift(0, at, f, J);
        add(NX * NX, SHARES[node], J, slope);
    }
    if (READ_OUT && slope) {
        secants(x, x_ref, x, M, H);
        mul(NX, N_PSI, NX, DRIFT, M, slope);
    }
    if (slope) add(NX * NX, 1.0, D, slope);
}

/* --- The sampled Riccati equation --- */

/* D of exp(F h) = I + D by its power series over a part of h, which is then doubled; y(0)' S y(0)
 * is the integral of y' diag(W) y under y' = F y (Van Loan 1978). */
static void over_interval(int n, double h, const double *F, const double *W, double *D, double *S)
{
    double power[4 * NN * NN], next[4 * NN * NN], weighed[4 * NN * NN];
    int doublings;
    frexp(size_of(n * n, F) * h * 1.4142135623730951, &doublings);
    doublings = doublings + 2 > 0 ? doublings + 2 : 0;
    h = ldexp(h, -doublings);
    fill(n * n, 0.0, D);
    fill(n * n, 0.0, S);
    fill(n * n, 0.0, weighed);
    diagonal(n, 1.0, power);
    for (int k = 1; k < 15; k++) {
        /* the block of Van Loan's matrix to the power of k above that of F */
        fill(n * n, 0.0, next);
        plus_turned(-h / k, n, n, n, F, weighed, next);
        EACH(i, n) add(n, W[i] * h / k, power + i * n, next + i * n);
        copy(n * n, next, weighed);
        add(n * n, 1.0, weighed, S);
        mul(n, n, n, power, F, next);
        fill(n * n, 0.0, power);
        add(n * n, h / k, next, power);
        add(n * n, 1.0, power, D);
    }
    copy(n * n, S, next);
    plus_turned(1.0, n, n, n, D, S, next);
    copy(n * n, next, S);
    symmetric(n, S);
    for (; doublings > 0; doublings--) {
        fill(n * n, 0.0, power);
        plus_turned(1.0, n, n, n, D, S, power);
        mul(n, n, n, power, D, next);
        EACH(i, n) EACH(j, n) next[i * n + j] += power[i * n + j] + power[j * n + i];
        add(n * n, 1.0, S, S);
        add(n * n, 1.0, next, S);
        mul(n, n, n, D, D, next);
        add(n * n, 1.0, D, D);
        add(n * n, 1.0, next, D);
    }
}

/* H = P of the discrete equation P = A' P (I + G P)^-1 A + H with A = I + D, by doubling (E. K.-W.
 * Chu, H.-Y. Fan, W.-W. Lin, C.-S. Wang, Int. J. Control 77 (2004)); returns 0 where A does not
 * vanish. D, which keeps its digits where the interval is short, and G are used up. */
static int doubled(int n, double *D, double *G, double *H) {
    double left[NR * NR], Y[NR * NR], V[NR * NR], T[NR * NR];
    EACH(step, 40) {
        diagonal(n, 1.0, left);
        plus(1.0, n, n, n, G, H, left);
        copy(n * n, D, Y);
        plus(-1.0, n, n, n, G, H, Y);
        copy(n * n, left, T);
        solve(n, n, T, Y);                          /* (I + G H)^-1 A = I + Y */
        copy(n * n, G, V);
        solve(n, n, left, V);
        copy(n * n, H, T);
        plus(1.0, n, n, n, H, Y, T);
        add(n * n, 1.0, T, H);
        plus_turned(1.0, n, n, n, D, T, H);         /* H + A' H (I + Y) */
        symmetric(n, H);
        copy(n * n, V, T);
        plus(1.0, n, n, n, D, V, T);
        EACH(i, n) EACH(j, n) G[i * n + j] += T[i * n + j] + dot(n, T + i * n, D + j * n);
        symmetric(n, G);                            /* G + A V A' */
        copy(n * n, Y, T);
        plus(1.0, n, n, n, D, Y, T);
        add(n * n, 1.0, T, D);                      /* A (I + Y) - I */
        diagonal(n, 1.0, T);
        add(n * n, 1.0, D, T);
        if (size_of(n * n, T) < 1e-10) return finite(n * n, H);
    }
    return 0;
}

/* The gain K (NU, n) of the regulator of x' = A x + B u with inputs that are held for h, or of the
 * continuous one where h is 0; the first NX states are weighted. Returns a status. */
static int riccati(int n, const double *A, const double *B, double h, double *K) {
    double F[NN * NN] = {0}, W[NN] = {0}, E[NN * NN], S[NN * NN], step[NR * NR], push[NR * NU];
    double Q[NR * NR] = {0}, R[NU * NU] = {0}, cross[NU * NR] = {0}, by_push[NU * NR], terms;
    double by_cross[NU * NR], left[NU * NU], right[NU * NR], D[NR * NR], G[NR * NR], P[NR * NR];
    double PA[NR * NR], PB[NR * NU], T[NR * NR], X[NR * NR], inverse[NR * NR], onto[NR * NU];
    int N = n + NU, held = h > 0.0;
    if (!finite(n * n, A) || !finite(n * NU, B)) return KOOPMAN_NOT_STABILISABLE;
    copy(NX, STATE_WEIGHT, W);
    copy(NU, INPUT_WEIGHT, W + n);
    copy(n * n, A, step);
    copy(n * NU, B, push);
    EACH(i, n) Q[i * n + i] = W[i];
    EACH(i, NU) R[i * NU + i] = W[n + i];
    if (held) {
        block(n, n, n, A, N, F);
        block(n, NU, NU, B, N, F + n);
        over_interval(N, h, F, W, E, S);
        block(n, n, N, E, n, step);
        block(n, NU, N, E + n, NU, push);
        block(n, n, N, S, n, Q);
        block(NU, n, N, S + n * N, n, cross);
        block(NU, NU, N, S + n * N + n, NU, R);
    }
    /* without the cross term: step - push R^-1 cross, push R^-1 push', Q - cross' R^-1 cross */
    transpose(n, NU, push, by_push);
    copy(NU * NU, R, left);
    solve(NU, n, left, by_push);
    copy(NU * n, cross, by_cross);
    copy(NU * NU, R, left);
    solve(NU, n, left, by_cross);
    mul(n, NU, n, push, by_push, G);
    copy(n * n, Q, P);
    copy(n * n, step, D);
    plus(-1.0, n, NU, n, push, by_cross, D);
    plus_turned(-1.0, n, NU, n, cross, by_cross, P);
    if (!held) {
        /* a discrete equation with the same solution, by a Cayley transform beyond all modes */
        double far = size_of(n * n, A) + sqrt(size_of(n * n, G) * size_of(n * n, Q));
        EACH(i, n) D[i * n + i] -= far;
        diagonal(n, 1.0, inverse);
        copy(n * n, D, T);
        solve(n, n, T, inverse);
        mul(n, n, n, inverse, G, X);
        transpose(n, n, D, T);
        plus(1.0, n, n, n, Q, X, T);
        diagonal(n, 2.0 * far, PA);
        solve(n, n, T, PA);
        transpose(n, n, PA, D);
        mul(n, n, n, X, PA, G);
        mul(n, n, n, PA, Q, X);
        mul(n, n, n, X, inverse, P);
    }
    if (!doubled(n, D, G, P)) return KOOPMAN_NOT_STABILISABLE;
    mul(n, n, n, P, step, PA);
    mul(n, n, NU, P, push, PB);
    EACH(i, NU) EACH(j, n) right[i * n + j] = cross[i * n + j] + PB[j * NU + i];
    copy(NU * NU, R, left);
    copy(n * n, Q, X);
    if (held) {
        plus_turned(1.0, NU, n, n, PB, step, right);
        plus_turned(1.0, NU, n, NU, push, PB, left);
        fill(n * n, 0.0, T);
        plus_turned(1.0, n, n, n, step, PA, T);
        add(n * n, 1.0, T, X);
    }
    terms = size_of(n * n, Q) + 2.0 * size_of(n * n, PA) + (held ? size_of(n * n, T) : 0.0);
    copy(NU * n, right, K);
    solve(NU, n, left, K);
    fill(n * n, 0.0, T);
    plus_turned(1.0, n, NU, n, right, K, T);
    terms += size_of(n * n, T);
    /* the equation less P on both sides, whose terms shrink with the interval */
    EACH(i, n) EACH(j, n) X[i * n + j] += PA[i * n + j] + PA[j * n + i] - T[i * n + j];
    if (!(size_of(n * n, X) / terms <= MAX_RESIDUAL)) return KOOPMAN_RICCATI_INACCURATE;
    return pseudo_inverse(NU, n, K, onto) <= MAX_GAIN ? KOOPMAN_OK : KOOPMAN_GAIN_TOO_LARGE;
}

/* --- Control laws --- */

typedef struct {
    double x[NX], u[NU], forcing[NX];   /* forcing: B(x) u + w */
} target_t;

/* Whether e' = slope e + action e(last sample) decays, or e' = (slope + action) e where h is 0. */
static int decays(const double *slope, const double *action, double h) {
    double F[4 * NX * NX] = {0}, W[2 * NX] = {0}, D[4 * NX * NX], S[4 * NX * NX], step[NX * NX];
    double next[NX * NX];
    int n = h > 0.0 ? 2 * NX : NX;
    EACH(i, NX) {
        copy(NX, slope + i * NX, F + i * n);
        add(NX, 1.0, action + i * NX, F + i * n + n - NX);
    }
    if (!finite(n * n, F)) return 0;
    over_interval(n, h > 0.0 ? h : 1.0, F, W, D, S);
    diagonal(NX, 1.0, step);
    EACH(i, NX) {
        add(NX, 1.0, D + i * n, step + i * NX);
        if (h > 0.0) add(NX, 1.0, D + i * n + NX, step + i * NX);
    }
    /* a power of the matrix decides */
    EACH(k, 50) {
        double size = size_of(NX * NX, step);
        if (!(size >= 1.0 && size < 1e100)) return size < 1.0;
        mul(NX, NX, NX, step, step, next);
        copy(NX * NX, next, step);
    }
    return 0;
}

/* u (NU) = u_ref - K e by the law of a model, in deviations; returns its status. */
static int law(int linear, const double *x, const target_t *target, double h, double *u) {
    double B[NX * NU], K[NU * NR], e[NR], M[NR * NX], slope[NX * NX], D[NX * NX], action[NX * NX];
    double KM[NU * NX];
    int status = KOOPMAN_NOT_STABILISABLE, n = NX;
    input_matrix(linear, x, NULL, B, NULL);
    if (linear) copy(NX * NX, SLOPE, slope);
    else averaged(x, target->x, target->u, READ_OUT ? slope : NULL, D);
    if (CLOSED && !linear) {
        /* re-centred: e = N(x) - N(x_ref), e' = (A + H C) e + N' B v */
        double psi[N_PSI], psi_ref[N_PSI], by_x[N_PSI * NX], psi_M[N_PSI * NX], psi_H[N_PSI * NX];
        double N[NZ * NX], H[NZ * NX], loop[NZ * NZ], push[NZ * NU], onto[NX * NZ], forcing[NX];
        double bend[N_PHI_ * NX * NX];
        copy(NX, target->forcing, forcing);
        plus(-1.0, NX, NX, 1, PRE_FEEDBACK, target->x, forcing);
        features(target->x, psi_ref, by_x, bend);
        features(x, psi, by_x, bend);
        secants(x, target->x, forcing, psi_M, psi_H);
        add(N_PSI, -1.0, psi_ref, psi);
        mul(NZ, N_PSI, 1, LIFT, psi, e);
        mul(NZ, N_PSI, NX, LIFT, by_x, N);
        mul(NZ, N_PSI, NX, LIFT, psi_M, M);
        mul(NZ, N_PSI, NX, LIFT, psi_H, H);
        add(NX * NX, -1.0, PRE_FEEDBACK, D);
        plus(1.0, NZ, NX, NX, N, D, H);
        copy(NZ * NZ, DYNAMICS, loop);
        EACH(i, NZ) add(NX, 1.0, H + i * NX, loop + i * NZ);
        mul(NZ, NX, NU, N, B, push);
        n = NZ;
        status = riccati(NZ, loop, push, h, K);
        if (status == KOOPMAN_OK && !READ_OUT) {
            plus(1.0, NZ, NZ, NX, DYNAMICS, M, H);
            pseudo_inverse(NZ, NX, N, onto);
            mul(NX, NZ, NX, onto, H, slope);
        }
    }
    if (status != KOOPMAN_OK) {
        if (!linear && !READ_OUT) averaged(x, target->x, target->u, slope, D);
        n = NX;
        diagonal(NX, 1.0, M);
        EACH(i, NX) e[i] = x[i] - target->x[i];
        status = riccati(NX, slope, B, h, K);
    }
    if (status != KOOPMAN_OK) return status;
    copy(NU, target->u, u);
    plus(-1.0, NU, n, 1, K, e, u);
    mul(NU, n, NX, K, M, KM);
    fill(NX * NX, 0.0, action);
    plus(-1.0, NX, NU, NX, B, KM, action);
    return decays(slope, action, h) ? KOOPMAN_OK : KOOPMAN_PREDICTED_UNSTABLE;
}

/* --- Steady states --- */

/* Solve f(x) + B(x) u + w = 0 for the free ones of y = (x, u) by Gauss-Newton steps, each to the
 * solution nearest to an anchor, in units of reach; returns 0 where there is none. */
static int equilibrium(int linear, const double *w, const int *free, const double *anchor,
                       const double *reach, double *y) {
    double rate[NX], J[NX * NX], B[NX * NU], scaled[NX * NXU], onto[NXU * NX], step[NXU];
    int index[NXU], n = 0;
    EACH(i, NXU) if (free[i]) index[n++] = i;
    rate_under(linear, y, y + NX, w, rate, J);
    EACH(count, 30) {
        double length = 0.0, slope = 0.0, share = 1.0;
        input_matrix(linear, y, NULL, B, NULL);
        EACH(i, NX) {
            rate[i] = -rate[i];
            EACH(j, n) {
                int k = index[j];
                double by = k < NX ? J[i * NX + k] : B[i * NU + k - NX];
                rate[i] += by * (y[k] - anchor[k]);
                scaled[i * n + j] = by * reach[k];
                slope += by * by;
            }
        }
        if (!isfinite(slope) || !finite(NX, rate)) return 0;
        pseudo_inverse(NX, n, scaled, onto);
        mul(n, NX, 1, onto, rate, step);
        EACH(j, n) {
            int k = index[j];
            step[j] = anchor[k] + reach[k] * step[j] - y[k];
            length = larger(length, fabs(step[j]));
        }
        if (length > 0.5) share = 0.5 / length;
        EACH(j, n) y[index[j]] += share * step[j];
        rate_under(linear, y, y + NX, w, rate, J);
        if (size_of(NX, rate) <= 1e-9 * sqrt(slope) && (length <= 1e-6 || n <= NX)) return 1;
    }
    return 0;
}

/* Index in y of the input furthest outside its range, and by how much. */
static int furthest(const double *y, double *excess) {
    int worst = 0;
    *excess = -INFINITY;
    EACH(i, NU) {
        double beyond = larger(LOWER_V[i] - y[NX + i], y[NX + i] - UPPER_V[i]);
        if (beyond > *excess) *excess = beyond, worst = i;
    }
    return NX + worst;
}

/* Hold the input at index k of y at the end of its range that it has left. */
static void hold_at_end(int k, int *free, double *y) {
    y[k] = smaller(larger(y[k], LOWER_V[k - NX]), UPPER_V[k - NX]);
    free[k] = 0;
}

/* y: the steady state with some states at a set-point, begun from y; returns 0 for none. */
static int partial_target(int linear, const double *goal, const double *w, double *y) {
    double anchor[NXU], reach[NXU], found[NXU], excess;
    int free[NXU];
    EACH(i, NXU) anchor[i] = 0.0, reach[i] = 1.0, free[i] = 1;
    EACH(i, NC) free[CONTROLLED[i]] = 0, y[CONTROLLED[i]] = goal[i];
    if (!equilibrium(linear, w, free, anchor, reach, y)) return 0;
    copy(NXU, y, found);
    EACH(spare, NU - NC) {
        int worst = furthest(found, &excess);
        if (!(excess > 0.0)) break;
        /* the others are to make up for what this one lacks */
        hold_at_end(worst, free, found);
        if (!equilibrium(linear, w, free, anchor, reach, found)) return 1;
    }
    furthest(found, &excess);
    if (!(excess > 0.0)) copy(NXU, found, y);
    return 1;
}

/* y: the steady state nearest to a target y that inputs within their range hold, if there is. */
static void reachable_target(int linear, const double *w, double *y) {
    double anchor[NXU], reach[NXU], found[NXU], excess;
    int free[NXU], worst;
    copy(NXU, y, anchor);
    copy(NXU, y, found);
    EACH(i, NXU) reach[i] = 1e3, free[i] = 1;
    EACH(i, NC) reach[CONTROLLED[i]] = 1.0;
    for (int count = 0; worst = furthest(found, &excess), excess > 1e-6; count++) {
        hold_at_end(worst, free, found);
        if (count == NU || !equilibrium(linear, w, free, anchor, reach, found)) return;
        /* further off it is on another branch */
        EACH(i, NX) if (!(fabs(found[i] - anchor[i]) <= 2.0 * HALF_WIDTH[i])) return;
    }
    copy(NXU, found, y);
}

/* The steady state of a set-point (NC), in state units, under a disturbance; 0 for none. */
static int find_target(int linear, const double *setpoint, const double *w, const double *start,
                       target_t *target) {
    double goal[NC], y[NXU] = {0}, f[NX], B[NX * NU], J[NX * NX], inverse[NU * NX], u[NU];
    int k, inside = 1;
    EACH(i, NC) k = CONTROLLED[i], goal[i] = (setpoint[i] - X_CENTER[k]) / X_SCALE[k];
    if (CONTROLS_ALL) {
        copy(NX, goal, y);
        drift(linear, y, f, J);
        add(NX, 1.0, w, f);
        input_matrix(linear, y, NULL, B, NULL);
        pseudo_inverse(NX, NU, B, inverse);
        plus(-1.0, NU, NX, 1, inverse, f, y + NX);
    } else {
        if (start) deviation(OF_X, start, y), deviation(OF_U, start + NX, y + NX);
        if (!partial_target(linear, goal, w, y)) return 0;
    }
    physical(OF_U, y + NX, u);
    EACH(i, NU) inside = inside && u[i] >= U_LOWER[i] && u[i] <= U_UPPER[i];
    if (NU > 1 && NC <= NU && !inside) reachable_target(linear, w, y);
    copy(NX, y, target->x);
    copy(NU, y + NX, target->u);
    input_matrix(linear, y, NULL, B, NULL);
    copy(NX, w, target->forcing);
    plus(1.0, NX, NU, 1, B, y + NX, target->forcing);
    return 1;
}

/* --- Estimation --- */

#define WIDTH (KALMAN ? 1 + NP : 1)

/* w (NX) within max_disturbance; none where it is not finite. */
static void bounded(double *w) {
    double v[NU], share = 0.0;
    mul(NU, NX, 1, INPUT_INVERSE, w, v);
    EACH(i, NU) share = larger(share, fabs(v[i]) / MAX_DISTURBANCE[i]);
    EACH(i, share <= 1.0 ? 0 : NX) w[i] = isfinite(share) ? w[i] / share : 0.0;
}

/* Rates of x and, in the columns behind it, of its derivatives by what x and w were. */
static void variations(int linear, const double *u, const double *w, const double *whole,
                       double *rate) {
    double x[NX], f[NX], J[NX * NX];
    block(NX, 1, WIDTH, whole, 1, x);
    rate_under(linear, x, u, w, f, J);
    mul(NX, NX, WIDTH, J, whole, rate);
    EACH(i, NX) {
        rate[i * WIDTH] = f[i];
        if (KALMAN) rate[i * WIDTH + 1 + NX + i] += 1.0;
    }
}

/* P (NP, NP) = F P F' */
static void congruent(const double *F, double *P) {
    double FP[NP * NP];
    mul(NP, NP, NP, F, P, FP);
    EACH(i, NP) EACH(j, NP) P[i * NP + j] = dot(NP, FP + i * NP, F + j * NP);
}

static int usable(const koopman_estimate *estimate) {
    return finite(NX, estimate->x) && finite(NX, estimate->w) && (
        !estimate->certain || finite(NP * NP, estimate->P));
}

/* Predict an estimate under an input (NU), in its units, for some seconds; 0 where it is lost: by
 * Heun's steps, or by those of order 4 with the variations of the Kalman filter. */
static int predicted(int linear, koopman_estimate *estimate, const double *input, double seconds) {
    static const double ahead[2][4] = {{0.0, 1.0}, {0.0, 0.5, 0.5, 1.0}};
    static const double parts[2][4] = {{3.0, 3.0}, {1.0, 2.0, 2.0, 1.0}};
    double u[NU], whole[NX * WIDTH] = {0}, at[NX * WIDTH], rate[NX * WIDTH] = {0}, F[NP * NP];
    double sum[NX * WIDTH], rates = seconds * (KALMAN ? FASTEST_MODE * 2.0 : FASTEST_RATE * 10.0);
    double count = larger(1.0, ceil(rates)), h = seconds / TIME_UNIT / count, *P = estimate->P;
    if (!(count <= (KALMAN ? 40.0 : 20.0))) return 0;
    deviation(OF_U, input, u);
    EACH(i, NX) {
        whole[i * WIDTH] = estimate->x[i];
        if (KALMAN) whole[i * WIDTH + 1 + i] = 1.0;
    }
    EACH(k, count) {
        fill(NX * WIDTH, 0.0, sum);
        EACH(stage, KALMAN ? 4 : 2) {
            copy(NX * WIDTH, whole, at);
            add(NX * WIDTH, ahead[KALMAN][stage] * h, rate, at);
            variations(linear, u, estimate->w, at, rate);
            add(NX * WIDTH, parts[KALMAN][stage], rate, sum);
        }
        add(NX * WIDTH, h / 6.0, sum, whole);
    }
    block(NX, 1, WIDTH, whole, 1, estimate->x);
    EACH(i, KALMAN ? 0 : NX) if (!(fabs(estimate->x[i]) <= 10.0 * HALF_WIDTH[i])) return 0;
    if (!KALMAN) return usable(estimate);
    if (!estimate->certain) copy(NP * NP, FIRST_COVARIANCE, P);
    EACH(i, NX) add(NX, seconds, INTENSITY + i * NX, P + (NX + i) * NP + NX);
    diagonal(NP, 1.0, F);
    block(NX, NP, WIDTH, whole + 1, NP, F);
    congruent(F, P);
    EACH(i, NX) if (!(P[i * NP + i] <= LOST_VARIANCE[i])) return 0;
    symmetric(NP, P);
    estimate->certain = 1;
    return usable(estimate);
}

/* Take the outputs of a state (NX) into account, so many seconds after the last ones. */
static void correct(koopman_estimate *estimate, const double *x, double seconds) {
    double error[NX], shown[NY], *P = estimate->P, p = exp(-BANDWIDTH * seconds);
    double HP[NY * NP], S[NY * NY], gain[NP * NY], keep[NP * NP];
    copy(NX, x, error);
    add(NX, -1.0, estimate->x, error);
    if (!REMEMBERS) {
        copy(NX, x, estimate->x);
        fill(NX, 0.0, estimate->w);
    } else if (!KALMAN) {
        add(NX, (1.0 - p) * (1.0 - p) / (seconds / TIME_UNIT), error, estimate->w);
        add(NX, 1.0 - p * p, error, estimate->x);
        bounded(estimate->w);
    } else {
        if (!estimate->certain) copy(NP * NP, FIRST_COVARIANCE, P);
        mul(NY, NX, 1, H_OUTPUT, error, shown);
        mul(NY, NX, NP, H_OUTPUT, P, HP);           /* P is symmetric */
        EACH(i, NY) EACH(j, NY) S[i * NY + j] =
            dot(NX, HP + i * NP, H_OUTPUT + j * NX) + (i == j ? NOISE_VARIANCE[i] : 0.0);
        solve(NY, NP, S, HP);
        transpose(NY, NP, HP, gain);
        diagonal(NP, 1.0, keep);
        EACH(i, NP) plus(-1.0, 1, NY, NX, gain + i * NY, H_OUTPUT, keep + i * NP);
        congruent(keep, P);
        EACH(k, NY) plus_turned(NOISE_VARIANCE[k], NP, 1, NP, HP + k * NP, HP + k * NP, P);
        symmetric(NP, P);
        estimate->certain = 1;
        plus(1.0, NX, NY, 1, gain, shown, estimate->x);
        plus(1.0, NX, NY, 1, gain + NX * NY, shown, estimate->w);
        bounded(estimate->w);
    }
}

/* What is left of a rate (NX) as a disturbance */
static void as_disturbance(const double *rate, double *w) {
    copy(NX, rate, w);
    if (KALMAN) mul(NX, NX, 1, ONTO_DISTURBANCES, rate, w);
    bounded(w);
}

/* Start from a measured state (NX): with the disturbance as known, or where u (NU) is not NULL the
 * one under which u holds the plant. */
static void restart(int linear, koopman_estimate *estimate, const double *x, const double *u) {
    double rate[NX], J[NX * NX], none[NX] = {0};
    if (!estimate->known || !REMEMBERS) fill(NX, 0.0, estimate->w);
    if (u && REMEMBERS) {
        rate_under(linear, x, u, none, rate, J);
        EACH(i, NX) rate[i] = -rate[i];
        as_disturbance(rate, estimate->w);
    }
    copy(NX, x, estimate->x);
    estimate->certain = 0;
    if (KALMAN) correct(estimate, x, 0.0);
    estimate->known = 1;
}

/* The level without regard to a passing reason. */
static int settled(const koopman_supervisor *s) {
    return s->resumes >= 0 ? s->resumes : s->level < 0 ? 0 : s->level;
}

/* The level in terms of whose model the estimate is. */
static int model_level(const koopman_supervisor *s) {
    return settled(s) < LAWS ? settled(s) : LAWS - 1;
}

/* Transfer an estimate from the model of a level to that of another; the plant's rate stays. */
static void transfer(koopman_estimate *estimate, int before, int now) {
    double f[NX], rate[NX], J[NX * NX];
    if (before == now || !REMEMBERS || !estimate->known) return;
    drift(LINEAR[before], estimate->x, rate, J);
    drift(LINEAR[now], estimate->x, f, J);
    EACH(i, NX) rate[i] = estimate->w[i] + rate[i] - f[i];
    as_disturbance(rate, estimate->w);
}

/* --- Time, and inputs under way --- */

/* Seconds since a time; 0 if it never was. */
static double since(const koopman_state *s, int64_t time) {
    return time == NEVER ? 0.0 : (double)(s->now - time) / SECOND;
}

/* The last input applied by a time, or the first one, by its place in the queue. */
static int applied_by(const koopman_state *s, int64_t time) {
    int k = s->queued - 1;
    while (k > 0 && s->applied_at[k] > time) k--;
    return k;
}

/* The input (NU) that acts on the plant from a time on. */
static void acting(const koopman_state *s, int64_t time, double *u) {
    EACH(i, NU) u[i] = s->applied[applied_by(s, time - DEAD_TIME[i])][i];
}

/* The end of the time from begin on, up to end, in which the same input (NU) acts. */
static int64_t piece(const koopman_state *s, int64_t begin, int64_t end, double *u) {
    for (int k = 1; k < s->queued; k++) EACH(i, NU) {
        int64_t edge = s->applied_at[k] + DEAD_TIME[i];
        if (edge > begin && edge < end) end = edge;
    }
    acting(s, begin, u);
    return end;
}

/* Append an input in place of those from its time on; drop those that no longer act. */
static void enqueue(koopman_state *s, int64_t time, const double *u) {
    int begin = 0;
    while (s->queued > 0 && s->applied_at[s->queued - 1] >= time) s->queued--;
    if (!LONGEST_DEAD_TIME) begin = s->queued;
    else if (s->queued > 0) begin = applied_by(s, time - LONGEST_DEAD_TIME);
    if (s->queued - begin == KOOPMAN_QUEUE) begin++;
    s->queued -= begin;
    EACH(k, s->queued) {
        s->applied_at[k] = s->applied_at[k + begin];
        copy(NU, s->applied[k + begin], s->applied[k]);
    }
    s->applied_at[s->queued] = time;
    copy(NU, u, s->applied[s->queued++]);
}

/* Predict an estimate up to now, where there is one; as uncertain as at first where it is lost. */
static void predict(const koopman_state *s, double elapsed, koopman_estimate *estimate) {
    koopman_estimate before = *estimate;
    int linear = LINEAR[model_level(&s->supervisor)];
    double u[NU];
    if (!estimate->known || !(elapsed > 0.0)) return;
    for (int64_t begin = s->commanded_at, end; begin < s->now; begin = end) {
        end = piece(s, begin, s->now, u);
        if (predicted(linear, estimate, u, (double)(end - begin) / SECOND)) continue;
        *estimate = before;
        estimate->certain = 0;
        return;
    }
}

/* The state (NX) of a measurement; what that leaves open is as estimated, or in a steady state. */
static void position(const koopman_estimate *estimate, const double *y, double *state) {
    double rest[NY], none[NX] = {0}, anchor[NXU] = {0}, reach[NXU], found[NXU] = {0};
    int free[NXU];
    mul(NX, NY, 1, FROM_OUTPUTS, y, state);
    if (DETERMINED) return;
    copy(NX, X_CENTER, state);
    if (estimate->known) physical(OF_X, estimate->x, state);
    copy(NY, y, rest);
    plus(-1.0, NY, NX, 1, OUTPUTS, state, rest);
    plus(1.0, NX, NY, 1, FROM_OUTPUTS, rest, state);
    if (estimate->known || !RESTS || !finite(NX, state)) return;
    EACH(i, NXU) reach[i] = 1.0, free[i] = i >= NX || !MEASURED[i];
    deviation(OF_X, state, found);
    if (equilibrium(0, none, free, anchor, reach, found)) physical(OF_X, found, state);
}

/* Check a measurement (NY) against the last accepted one, of `before`, and renew that in s. */
static int check(const koopman_state *before, koopman_state *s, const double *y, double elapsed,
                 double outside, int *moved) {
    koopman_estimate moves = before->estimate;
    double seconds = since(s, before->accepted_at), worst = 0.0, change[NY], way[NX];
    double travel[NY] = {0};
    int first = before->accepted_at == NEVER, still = 0, stuck = 0;
    *moved = 0;
    EACH(i, NY) {
        if (!isfinite(y[i])) return KOOPMAN_NOT_FINITE;
        if (!(y[i] >= SENSOR_LOWER[i] && y[i] <= SENSOR_UPPER[i])) return KOOPMAN_OUTSIDE_SENSOR;
    }
    EACH(i, first ? 0 : NY) {
        change[i] = fabs(y[i] - before->accepted[i]);
        worst = larger(worst, change[i] / (MAX_STEP[i] + MAX_RATE[i] * seconds));
        *moved = *moved || (before->jumped && change[i] > MAX_STEP[i]);
        still = still || change[i] == 0.0;
    }
    s->jumped = worst > 1.0;
    if (s->jumped) return KOOPMAN_JUMPED;
    copy(NY, y, s->accepted);
    s->accepted_at = s->now;
    if (!still) {
        fill(NX, 0.0, s->still_w);
        if (moves.known) copy(NX, moves.w, s->still_w);
    } else if (!(outside > 0.0) && !before->recovering && moves.known) {
        /* elsewhere the model's motion is worth little */
        copy(NX, before->still_w, moves.w);
        predict(before, elapsed, &moves);
        EACH(i, NX) way[i] = (moves.x[i] - before->estimate.x[i]) * X_SCALE[i];
        mul(NY, NX, 1, OUTPUTS, way, travel);
    }
    EACH(i, NY) {
        if (!still || change[i] != 0.0) s->still_since[i] = s->now, s->travel[i] = 0.0;
        else s->travel[i] += travel[i];
        stuck = stuck || (fabs(s->travel[i]) > 0.5 * MAX_STEP[i] && STUCK_TIMEOUT > 0.0
                          && since(s, s->still_since[i]) > STUCK_TIMEOUT);
    }
    return stuck ? KOOPMAN_FROZEN : KOOPMAN_OK;
}

/* Take into account that the last command was not followed, where applied inputs are measured. */
static void follow(koopman_state *s, const double *applied) {
    double *last = s->applied[s->queued - 1];
    EACH(i, finite(NU, applied) ? NU : 0)
        last[i] = smaller(larger(s->command[i], applied[i] - TOLERANCE[i]),
                          applied[i] + TOLERANCE[i]);
}

/* Check a measurement and take it into account: the state (NX) it stands for, in its units, and
 * its distance from the training data. */
static int observe(koopman_state *s, const double *y, double elapsed, double *outside,
                   double *state) {
    const koopman_state before = *s;
    koopman_estimate *estimate = &s->estimate;
    double x[NX], u[NU], held[NU], silent = since(s, before.accepted_at);
    int moved, fault, linear = LINEAR[model_level(&s->supervisor)];
    predict(s, elapsed, estimate);
    position(estimate, y, state);
    *outside = distance(state);
    fault = check(&before, s, y, elapsed, *outside, &moved);
    s->measured_at = s->now;
    /* what the observer made of a sensor that does not move is no disturbance */
    if (fault == KOOPMAN_FROZEN && estimate->known) copy(NX, before.still_w, estimate->w);
    if (fault != KOOPMAN_OK) return fault;
    deviation(OF_X, state, x);
    if (!estimate->known) {
        if (s->commanded) acting(s, s->now, held), deviation(OF_U, held, u);
        restart(linear, estimate, x, s->commanded ? u : NULL);
    } else if (moved || !(elapsed > 0.0) || *outside > MARGIN[LAWS - 1]
               || (silent * BANDWIDTH > 2.0 && silent > 1.5 * s->interval)) {
        restart(linear, estimate, x, NULL);
    } else {
        correct(estimate, x, elapsed);
    }
    if (!DETERMINED) position(estimate, y, state);
    *outside = distance(state);
    return KOOPMAN_OK;
}

/* --- The control step --- */

typedef struct {
    int level, passing, status, cause;
} request_t;

/* Fall back at once, and recover when that was possible for long enough. */
static koopman_supervisor supervised(const koopman_supervisor *s, request_t to, int64_t now) {
    int from = settled(s);
    int64_t better = s->better_since == NEVER ? now : s->better_since;
    koopman_supervisor next = {to.level, -1, to.status, to.cause, NEVER, NEVER};
    if (to.level == KOOPMAN_HOLD) {
        next.bad_since = s->bad_since == NEVER ? now : s->bad_since;
        int too_long = (double)(now - next.bad_since) / SECOND > HOLD_TIMEOUT;
        if (too_long) next.status = KOOPMAN_HELD_TOO_LONG;
        if (too_long || (s->level == KOOPMAN_SAFE && s->bad_since != NEVER)) {
            next.level = KOOPMAN_SAFE;
            to.passing = 0;
        }
    }
    if (to.passing && from < next.level) next.resumes = from;
    else if (to.passing && next.level == KOOPMAN_HOLD && from > KOOPMAN_HOLD) next.level = from;
    else if (next.level < from && (double)(now - better) / SECOND < RECOVERY_TIME)
        next = (koopman_supervisor){from, -1, s->status == KOOPMAN_OK ? KOOPMAN_OK
                                    : KOOPMAN_RECOVERING, s->cause, s->bad_since, better};
    return next;
}

/* The level that the distance from the training data allows; a margin is left at half of it. */
static request_t allowed(const koopman_supervisor *s, double outside) {
    for (int k = LAWS - 1; k >= 0; k--) {
        int below = k < LAWS - 1 ? k + 1 : KOOPMAN_SAFE;
        if (outside > 0.0 && outside > (settled(s) >= below ? 0.5 : 1.0) * MARGIN[k])
            return (request_t){below, 0, KOOPMAN_OUTSIDE_TRAINING, KOOPMAN_OUTSIDE_TRAINING};
    }
    return (request_t){0, 0, KOOPMAN_OK, KOOPMAN_OK};
}

/* Bring a command within its range, and within its rate. */
static void limit(const double *wanted, const double *previous, double seconds, double *u) {
    EACH(i, NU) {
        double reach = isinf(RATE_LIMIT[i]) ? INFINITY : RATE_LIMIT[i] * larger(0.0, seconds);
        double value = smaller(larger(wanted[i], U_LOWER[i]), U_UPPER[i]);
        if (previous) value = smaller(larger(value, previous[i] - reach), previous[i] + reach);
        u[i] = value;
    }
}

/* Evaluate a law, in units within range; returns its status. */
static int evaluate(int linear, const double *x, const target_t *target, double interval,
                    double *u) {
    double v[NU], wanted[NU];
    int status = law(linear, x, target, interval / TIME_UNIT, v);
    if (status != KOOPMAN_OK) return status;
    physical(OF_U, v, wanted);
    limit(wanted, NULL, 0.0, u);
    return finite(NU, wanted) ? KOOPMAN_OK : KOOPMAN_COMMAND_NOT_FINITE;
}

/* Predict an estimate from one time to another, short pieces by their mean; 0 where it is lost.
 * Inputs with a dead time up to `acts` are held at `held`. */
static int ahead(const koopman_state *s, int linear, int64_t begin, int64_t end, int64_t acts,
                 const double *held, koopman_estimate *estimate) {
    double step = FASTEST_RATE > 0.0 ? 0.1 / FASTEST_RATE : INFINITY, time = 0.0, u[NU];
    double mean[NU] = {0};
    for (int64_t next; begin < end; begin = next) {
        next = piece(s, begin, end, u);
        double seconds = (double)(next - begin) / SECOND, count;
        EACH(i, NU) mean[i] += seconds * (DEAD_TIME[i] <= acts ? held[i] : u[i]);
        time += seconds;
        if (time < step && next < end) continue;
        count = larger(1.0, ceil(time / (10.0 * step)));
        EACH(i, NU) mean[i] /= time;
        EACH(k, count) if (!predicted(linear, estimate, mean, time / count)) return 0;
        fill(NU, 0.0, mean);
        time = 0.0;
    }
    return 1;
}

/* Evaluate the law for each input at the state predicted for the time at which it acts; the faster
 * inputs follow the law until then. */
static int evaluate_ahead(const koopman_state *s, int linear, koopman_estimate *estimate,
                          const target_t *target, double interval, double *u) {
    const double span = (double)(LONGEST_DEAD_TIME - SHORTEST_DEAD_TIME);
    double held[NU], later[NU], count = interval > 0.0 ? ceil(span / SECOND / interval) : 1.0;
    int status;
    if (!s->queued) return evaluate(linear, estimate->x, target, interval, u);
    if (!ahead(s, linear, s->now, s->now + SHORTEST_DEAD_TIME, -1, u, estimate))
        return KOOPMAN_NOT_PREDICTED;
    status = evaluate(linear, estimate->x, target, interval, u);
    copy(NU, u, held);
    count = smaller(20.0, count);
    for (int64_t begin = SHORTEST_DEAD_TIME, end; begin < LONGEST_DEAD_TIME; begin = end) {
        if (status != KOOPMAN_OK) return status;
        end = LONGEST_DEAD_TIME;
        EACH(i, NU) if (DEAD_TIME[i] > begin && DEAD_TIME[i] < end) end = DEAD_TIME[i];
        EACH(k, count) {
            int64_t edge = (int64_t)rint(k * (span / count) + (double)SHORTEST_DEAD_TIME);
            if (edge > begin && edge < end) end = edge;
        }
        if (!ahead(s, linear, s->now + begin, s->now + end, begin, held, estimate))
            return KOOPMAN_NOT_PREDICTED;
        status = evaluate(linear, estimate->x, target, (double)(end - begin) / SECOND, later);
        EACH(i, NU) if (DEAD_TIME[i] == end) u[i] = later[i];
        limit(later, held, (double)(end - begin) / SECOND, held);
    }
    return status;
}

/* Follow how far the plant has come back where the safe input keeps it outside. */
static void recover(koopman_state *s, int fault, double outside) {
    double state[NX], x[NX], u[NU], u_safe[NU], B[NX * NU], rate[NX];
    int was = s->recovering, kept = s->supervisor.bad_since == NEVER
        && s->supervisor.better_since == NEVER;
    s->recovering = 0;
    if (s->supervisor.level != KOOPMAN_SAFE || fault != KOOPMAN_OK) return;
    position(&s->estimate, s->accepted, state);
    deviation(OF_X, state, x);
    deviation(OF_U, NOMINAL, u);
    deviation(OF_U, SAFE, u_safe);
    add(NU, -1.0, u_safe, u);
    input_matrix(0, x, NULL, B, NULL);
    mul(NX, NU, 1, B, u, rate);
    if (outside > 0.0 ? !(dot(NX, x, rate) < 0.0) : !(was && s->led)) return;
    if (!was && !kept) return;
    s->recovering = 1;
    if (was) {
        double change = outside - s->farthest, still = 0.03 * (1.0 + s->farthest);
        if (!(change > still || (change < -still && !s->led))) {
            s->led = s->led || since(s, s->resting_since) >= 3.0 * RECOVERY_TIME;
            s->nearest = smaller(s->nearest, outside);
            return;
        }
    }
    s->led = 0;
    s->farthest = s->nearest = outside;
    s->resting_since = s->now;
}

/* Let the offset of a bumpless transfer fade with d (1 + t/T) exp(-t/T). */
static void fade(koopman_state *s, double seconds) {
    double share = seconds / TRANSFER_TIME, offset = 0.0, feed = 0.0;
    EACH(i, NU) {
        s->offset[i] = exp(-share) * (s->offset[i] + share * s->feed[i]);
        s->feed[i] *= exp(-share);
        offset = larger(offset, fabs(s->offset[i]));
        feed = larger(feed, fabs(s->feed[i]));
    }
    s->transferring = share <= 100.0 && offset + feed > 1e-9;
}

/* The input before limits that a law, or none, gives, and the state with it. */
static void automatic(koopman_state *s, int fault, double outside, double elapsed, double interval,
                      double *wanted) {
    const koopman_supervisor before = s->supervisor;
    request_t to = allowed(&before, outside);
    target_t target = {{0.0}, {0.0}, {0.0}};
    double u[NU] = {0}, start[NXU];
    int targeted = 0, from = model_level(&before), level;
    if (fault != KOOPMAN_OK) to = (request_t){KOOPMAN_HOLD, 1, fault, fault};
    copy(NXU, s->target, start);
    for (;;) {
        s->supervisor = supervised(&before, to, s->now);
        level = s->supervisor.level;
        if (level >= LAWS) break;
        koopman_estimate estimate = s->estimate;
        int status = KOOPMAN_NO_STEADY_STATE, linear = LINEAR[level], lost;
        transfer(&estimate, from, level);
        targeted = find_target(linear, s->setpoint, estimate.w, s->targeted ? start : NULL,
                               &target);
        lost = level + 1 < LAWS && !linear && failed_near(estimate.x, target.x);
        if (targeted) status = evaluate_ahead(s, linear, &estimate, &target, interval, u);
        if (status != KOOPMAN_OK)
            to = (request_t){level + 1, 0, KOOPMAN_LAW_FAILED, status};
        else if (lost)
            to = (request_t){level + 1, 0, KOOPMAN_LOST_HERE, KOOPMAN_LOST_HERE};
        else break;
    }
    recover(s, fault, outside);
    transfer(&s->estimate, from, model_level(&s->supervisor));
    if (targeted && !CONTROLS_ALL) {
        physical(OF_X, target.x, s->target);
        physical(OF_U, target.u, s->target + NX);
        s->targeted = 1;
    }
    copy(NU, s->command, wanted);
    if (level < LAWS) {
        if (s->law != level && s->commanded && TRANSFER_TIME > 0.0) {
            EACH(i, NU) s->offset[i] = s->feed[i] = s->command[i] - u[i];
            s->transferring = 1;
        } else if (s->transferring) {
            fade(s, elapsed);
        }
        copy(NU, u, wanted);
        if (s->transferring) add(NU, 1.0, s->offset, wanted);
        s->law = level;
    } else if (s->supervisor.resumes < 0) {
        s->law = -1;
    }
    if (level == KOOPMAN_SAFE) {
        double led = s->recovering && s->led ? smaller(1.0, 1.25 - s->nearest / s->farthest) : 0.0;
        EACH(i, NU) wanted[i] = SAFE[i] + led * (NOMINAL[i] - SAFE[i]);
        s->transferring = 0;
    }
}

/* Command, after a measurement that is accepted or has a fault, or without one. */
static void command(koopman_state *s, int fault, double outside, double elapsed, double interval,
                    double counted) {
    double wanted[NU];
    if (!s->commanded) copy(NU, U_CENTER, s->command);
    if (s->manual) {
        copy(NU, s->manual_known ? s->manual_input : s->command, wanted);
        s->law = -1;
        s->transferring = 0;
    } else {
        automatic(s, fault, outside, elapsed, interval, wanted);
    }
    limit(wanted, s->commanded ? s->command : NULL, counted, s->command);
    s->commanded = 1;
    s->commanded_at = s->now;
    enqueue(s, s->now, s->command);
}

/* Bring the set-point to the present time; it begins from a state (NX), in its units. */
static void advance(koopman_state *s, const double *x, double seconds) {
    EACH(i, NC) {
        int k = CONTROLLED[i];
        double *active = s->setpoint + i, *ramped = s->ramped + i, reach = INFINITY;
        if (!s->active) *active = *ramped = smaller(larger(x[k], X_LOWER[k]), X_UPPER[k]);
        if (isnan(s->requested[i])) s->requested[i] = *active;
        if (!isinf(SETPOINT_RAMP[i])) reach = SETPOINT_RAMP[i] * seconds;
        *ramped = smaller(larger(s->requested[i], *ramped - reach), *ramped + reach);
        if (FILTER_TIME > 0.0) *active -= expm1(-seconds / FILTER_TIME) * (*ramped - *active);
        else *active = *ramped;
    }
    s->active = 1;
}

/* Take requests of the operator; returns 1 where the set-point is refused. */
static int requests(koopman_state *s, const koopman_inputs *inputs) {
    int refused = 0;
    if (!inputs->manual != !s->manual) {
        s->manual = !s->manual;
        s->manual_known = s->recovering = 0;
        transfer(&s->estimate, model_level(&s->supervisor), 0);
        s->supervisor = (koopman_supervisor){-1, -1, KOOPMAN_OK, KOOPMAN_OK, NEVER, NEVER};
    }
    if (s->manual && finite(NU, inputs->manual_input)) {
        copy(NU, inputs->manual_input, s->manual_input);
        s->manual_known = 1;
    }
    EACH(i, NC) refused = refused || inputs->setpoint[i] < X_LOWER[CONTROLLED[i]]
        || inputs->setpoint[i] > X_UPPER[CONTROLLED[i]];
    EACH(i, refused ? 0 : NC)
        if (!isnan(inputs->setpoint[i])) s->requested[i] = inputs->setpoint[i];
    return refused;
}

void koopman_init(koopman_state *s, const double *applied) {
    *s = (koopman_state){0};
    s->measured_at = s->commanded_at = s->accepted_at = NEVER;
    s->law = -1;
    s->interval = INFINITY;
    s->supervisor = (koopman_supervisor){-1, -1, KOOPMAN_OK, KOOPMAN_OK, NEVER, NEVER};
    fill(NC, NAN, s->requested);
    if (!applied || !finite(NU, applied)) return;
    limit(applied, NULL, 0.0, s->command);
    s->commanded = 1;
    enqueue(s, NEVER, applied);
}

void koopman_step(koopman_state *s, const koopman_inputs *inputs, koopman_outputs *outputs) {
    int fault = KOOPMAN_OK, received = inputs->received;
    if (inputs->elapsed_ns > 0) s->now += inputs->elapsed_ns;
    outputs->setpoint_refused = requests(s, inputs);
    if (received ? !s->commanded || s->measured_at != s->now : s->commanded) {
        double usual = isinf(s->interval) ? 0.0 : s->interval, gap = since(s, s->measured_at);
        double elapsed = since(s, s->commanded_at), outside = NAN, counted = 0.0, state[NX];
        double interval = received ? smaller(usual, elapsed) : usual;
        if (!received) counted = smaller(elapsed, larger(1.0, 2.0 * usual));
        if (received && s->measured_at != NEVER && elapsed > 0.0) {
            /* neither a gap nor a burst is the spacing of the samples */
            gap = smaller(gap, 2.0 * s->interval);
            s->interval = larger(gap, 0.5 * usual);
            counted = smaller(gap, elapsed);
        }
        const koopman_state before = *s;
        if (received) {
            if (s->commanded) follow(s, inputs->applied);
            fault = observe(s, inputs->measured, elapsed, &outside, state);
            if (fault == KOOPMAN_OK) advance(s, state, counted);
        } else {
            fault = KOOPMAN_NO_MEASUREMENT;
            predict(s, elapsed, &s->estimate);
        }
        command(s, fault, outside, elapsed, interval, counted);
        if (!finite(NU, s->command) || (s->estimate.known && !usable(&s->estimate))) {
            *s = before;
            if (received) s->measured_at = s->now;
            s->law = -1;
            s->transferring = s->recovering = s->targeted = s->estimate.known = 0;
            fault = KOOPMAN_CALCULATION_FAILED;
            command(s, fault, NAN, elapsed, interval, counted);
        }
    }
    int level = s->manual ? KOOPMAN_MANUAL : s->supervisor.level < 0 ? 0 : s->supervisor.level;
    int status = s->manual ? fault : s->supervisor.status;
    int cause = s->manual ? fault : s->supervisor.cause;
    outputs->level = s->commanded ? level : KOOPMAN_SAFE;
    outputs->status = s->commanded ? status : KOOPMAN_NO_MEASUREMENT;
    outputs->cause = s->commanded ? cause : KOOPMAN_NO_MEASUREMENT;
    copy(NU, s->commanded ? s->command : SAFE, outputs->command);
    fill(NX, NAN, outputs->state);
    if (s->estimate.known) physical(OF_X, s->estimate.x, outputs->state);
    fill(NC, NAN, outputs->setpoint);
    if (s->active) copy(NC, s->setpoint, outputs->setpoint);
}
