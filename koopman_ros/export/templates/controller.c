/* SPDX-FileCopyrightText: 2026 The koopman_ros Authors
 * SPDX-License-Identifier: Apache-2.0
 *
@ABOUT@
 */
#include "controller.h"

#include <math.h>
#include <stddef.h>

@TABLES@

#define OF_X NX, STATES_CENTER, STATES_SCALE
#define OF_U NU, INPUTS_EFFECT, INPUTS_SCALE
#define OF_D ND, DISTURBANCES_CENTER, DISTURBANCES_SCALE
#define NEVER INT64_MIN
#define SECOND 1e9
#define EACH(i, n) for (int i = 0; i < (n); i++)

/* A matrix (m, n) by rows; a vector is one with a single column. */
typedef struct {
    int m, n;
    double a[MOST];
} mat;

/* These pass on a NaN, as the comparisons of the language do not. */
static double larger(double a, double b) { return isnan(a) || a > b ? a : b; }
static double smaller(double a, double b) { return isnan(a) || a < b ? a : b; }
static double within(double value, double lower, double upper) {
    return smaller(larger(value, lower), upper);
}

static mat of(int m, int n, const double *from) {
    mat A = {m, n, {0}};
    EACH(k, from ? m * n : 0) A.a[k] = from[k];
    return A;
}

static mat zeros(int m, int n) { return of(m, n, NULL); }

static void store(mat A, double *to) { EACH(k, A.m * A.n) to[k] = A.a[k]; }

static mat diagonal(int n, double value) {
    mat A = zeros(n, n);
    EACH(i, n) A.a[i * n + i] = value;
    return A;
}

/* A + f B */
static mat plus(mat A, double f, mat B) {
    EACH(k, A.m * A.n) A.a[k] += f * B.a[k];
    return A;
}

static mat scaled(double f, mat A) { return plus(zeros(A.m, A.n), f, A); }

static mat transposed(mat A) {
    mat B = zeros(A.n, A.m);
    EACH(i, A.m) EACH(j, A.n) B.a[j * A.m + i] = A.a[i * A.n + j];
    return B;
}

static mat symmetric(mat A) { return scaled(0.5, plus(A, 1.0, transposed(A))); }

/* C + f A B */
static mat plus_mul(mat C, double f, mat A, mat B) {
    EACH(i, A.m) EACH(k, A.n) EACH(j, B.n)
        C.a[i * B.n + j] += f * A.a[i * A.n + k] * B.a[k * B.n + j];
    return C;
}

static mat mul(mat A, mat B) { return plus_mul(zeros(A.m, B.n), 1.0, A, B); }

/* The block (m, n) of A from row i and column j on */
static mat block(mat A, int i, int j, int m, int n) {
    mat B = zeros(m, n);
    EACH(k, m) EACH(l, n) B.a[k * n + l] = A.a[(i + k) * A.n + j + l];
    return B;
}

static void put(mat *A, int i, int j, mat B) {
    EACH(k, B.m) EACH(l, B.n) A->a[(i + k) * A->n + j + l] = B.a[k * B.n + l];
}

static double size(mat A) {
    double sum = 0.0;
    EACH(k, A.m * A.n) sum += A.a[k] * A.a[k];
    return sqrt(sum);
}

static int all_finite(mat A) {
    EACH(k, A.m * A.n) if (!isfinite(A.a[k])) return 0;
    return 1;
}

/* y = y + f x */
static void add(int n, double f, const double *x, double *y) { EACH(i, n) y[i] += f * x[i]; }

/* x, y = v x - u y, u x + v y */
static void turn(int n, double u, double v, double *x, double *y) {
    EACH(i, n) {
        double kept = x[i];
        x[i] = v * kept - u * y[i];
        y[i] = u * kept + v * y[i];
    }
}

static void swap(int n, double *x, double *y) {
    EACH(i, n) {
        double kept = x[i];
        x[i] = y[i];
        y[i] = kept;
    }
}

/* A^-1 B by elimination with pivots */
static mat solve(mat A, mat B) {
    int n = A.n, m = B.n;
    EACH(k, n) {
        double *a = A.a + k * n, *b = B.a + k * m;
        int pivot = k;
        for (int i = k + 1; i < n; i++)
            if (fabs(A.a[i * n + k]) > fabs(A.a[pivot * n + k])) pivot = i;
        swap(n, a, A.a + pivot * n);
        swap(m, b, B.a + pivot * m);
        EACH(i, n) {
            double factor = i == k ? 0.0 : A.a[i * n + k] / a[k];
            add(n, -factor, a, A.a + i * n);
            add(m, -factor, b, B.a + i * m);
        }
    }
    EACH(k, n) EACH(j, m) B.a[k * m + j] /= A.a[k * n + k];
    return B;
}

/* The pseudo-inverse, with singular values up to `least` taken for 0: rotations make the rows of A
 * orthogonal (M. R. Hestenes, SIAM J. 6 (1958)). */
static mat inverse(mat A, double least) {
    if (A.m > A.n) return transposed(inverse(transposed(A), least));
    mat R = diagonal(A.m, 1.0);
    int turned = 1;
    for (int sweep = 0; turned && sweep < 40; sweep++) {
        turned = 0;
        EACH(p, A.m) for (int q = p + 1; q < A.m; q++) {
            double a = 0.0, b = 0.0, c = 0.0, *x = A.a + p * A.n, *y = A.a + q * A.n;
            EACH(k, A.n) {
                a += x[k] * x[k];
                b += y[k] * y[k];
                c += x[k] * y[k];
            }
            if (!(fabs(c) > 1e-15 * sqrt(a * b))) continue;
            double half = (b - a) / (2.0 * c);
            double t = copysign(1.0, half) / (fabs(half) + sqrt(1.0 + half * half));
            double u = t / sqrt(1.0 + t * t), v = 1.0 / sqrt(1.0 + t * t);
            turn(A.n, u, v, x, y);
            turn(A.m, u, v, R.a + p * A.m, R.a + q * A.m);
            turned = 1;
        }
    }
    EACH(p, A.m) {
        double value = size(block(A, p, 0, 1, A.n));
        EACH(k, A.m) R.a[p * A.m + k] *= value > least ? 1.0 / (value * value) : 0.0;
    }
    return mul(transposed(A), R);
}

/* The size of the fastest mode of A, from its power 8 */
static double fastest_rate(mat A) {
    double whole = size(A);
    if (!(whole > 0.0 && whole < INFINITY)) return whole;
    A = scaled(1.0 / whole, A);
    EACH(k, 3) A = mul(A, A);
    return whole * pow(size(A), 0.125);
}

/* Whether all eigenvalues of A are within the unit circle: a power of A decides. */
static int contracts(mat A) {
    EACH(k, 50) {
        if (!(size(A) >= 1.0 && size(A) < 1e100)) return size(A) < 1.0;
        A = mul(A, A);
    }
    return 0;
}

/* --- The model, in scaled deviations from the nominal point --- */

static mat deviation(int n, const double *center, const double *scale, const double *value) {
    mat x = zeros(n, 1);
    EACH(i, n) x.a[i] = (value[i] - center[i]) / scale[i];
    return x;
}

static mat physical(int n, const double *center, const double *scale, mat x) {
    EACH(i, n) x.a[i] = center[i] + x.a[i] * scale[i];
    return x;
}

/* The function of input i from `x` to `y`, piecewise linear with slope 1 beyond its ends: its
 * characteristic or the inverse. */
static double mapped(int i, const double *x, const double *y, double at) {
    int k = CURVES[i], last = CURVES[i + 1] - 1;
    double inside = last > k ? within(at, x[k], x[last]) : at;
    if (last < k || isinf(at)) return at;
    while (k < last - 1 && inside > x[k + 1]) k++;
    return y[k] + (y[k + 1] - y[k]) / (x[k + 1] - x[k]) * (inside - x[k]) + (at - inside);
}

static mat input_deviation(const double *u) {
    double effect[NU];
    EACH(i, NU) effect[i] = mapped(i, CURVE_VALUES, CURVE_EFFECTS, u[i]);
    return deviation(OF_U, effect);
}

static mat physical_input(mat v) {
    v = physical(OF_U, v);
    EACH(i, NU) v.a[i] = mapped(i, CURVE_EFFECTS, CURVE_VALUES, v.a[i]);
    return v;
}

static double apart(const double *a, const double *b) {
    double distance = 0.0;
    EACH(i, NX) distance = larger(distance, fabs((a[i] - b[i]) / HALF_WIDTH[i]));
    return distance;
}

/* Distance of a state, in its units, from the training data in half-ranges */
static double distance(mat state) {
    mat x = deviation(OF_X, state.a);
    double out = 0.0, nearest = INFINITY;
    if (!all_finite(x)) return INFINITY;
    EACH(i, NX)
        out = larger(out, larger(CORNERS[i] - x.a[i], x.a[i] - CORNERS[NX + i]) / HALF_WIDTH[i]);
    EACH(k, N_TRAINING) nearest = smaller(nearest, apart(TRAINING_STATES_STATES + k * NX, x.a));
    return N_TRAINING ? larger(out, nearest - TRAINING_STATES_FILL_DISTANCE) : out;
}

/* Whether the law failed in the tested loop nearest to a state and a set-point */
static int failed_near(mat x, mat x_ref) {
    double nearest[2] = {INFINITY, INFINITY};
    EACH(k, N_LOOPS) {
        double start = apart(VERIFIED_LOOPS_STARTS + k * NX, x.a);
        double *least = nearest + VERIFIED_LOOPS_LOST[k];
        *least = smaller(*least, larger(start, apart(VERIFIED_LOOPS_SETPOINTS + k * NX, x_ref.a)));
    }
    return nearest[1] < nearest[0];
}

static double dot(const double *x, const double *y) {
    double sum = 0.0;
    EACH(i, NX) sum += x[i] * y[i];
    return sum;
}

/* Product of the powers of x, differentiated by x_i and x_j where these are not negative */
static double monomial(const int *powers, mat x, int i, int j) {
    double value = 1.0;
    EACH(k, NX) {
        int power = powers[k];
        if (k == i) value *= power--;
        if (k == j) value *= power--;
        while (power-- > 0) value *= x.a[k];
    }
    return value;
}

/* The feature k of the lift (1, 1), its slope (1, NX) and its bend (NX, NX) */
static mat feature(int k, mat x, mat *slope, mat *bend) {
    const double *w = OBSERVABLES_W + k * NX;
    const int *powers = POWERS + k * NX;
    double h = NETWORK ? tanh(OBSERVABLES_B[k] + dot(w, x.a)) : 0.0, s = 1.0 - h * h;
    mat value = zeros(1, 1);
    value.a[0] = NETWORK ? h - AT_ZERO[k] : monomial(powers, x, -1, -1);
    *slope = zeros(1, NX);
    *bend = zeros(NX, NX);
    EACH(i, NX) {
        slope->a[i] = NETWORK ? s * w[i] : monomial(powers, x, i, -1);
        EACH(j, NX) bend->a[i * NX + j] =
            NETWORK ? -2.0 * h * s * w[i] * w[j] : monomial(powers, x, i, j);
    }
    return value;
}

/* O psi with psi = (x, features) and O (rows, N_PSI): its columns of x, or of feature k times a
 * row that is added to A. */
static mat of_states(int rows, const double *O) {
    mat A = zeros(rows, NX);
    EACH(i, rows) EACH(j, NX) A.a[i * NX + j] = O[i * N_PSI + j];
    return A;
}

static void of_feature(int k, const double *O, mat row, mat *A) {
    EACH(i, A->m) add(row.n, O[i * N_PSI + NX + k], row.a, A->a + i * row.n);
}

/* O psi (rows, 1) and its derivative N (rows, NX) */
static mat lift(int rows, const double *O, mat x, mat *N) {
    mat z = mul(*N = of_states(rows, O), x), slope, bend;
    EACH(k, N_PHI) {
        of_feature(k, O, feature(k, x, &slope, &bend), &z);
        of_feature(k, O, slope, N);
    }
    return z;
}

static mat between(mat x_ref, mat x, int node) {
    return plus(x_ref, NODES[node], plus(x, -1.0, x_ref));
}

/* Secants of O psi and H of O psi' w between two states, (rows, NX) */
static mat secants(int rows, const double *O, mat x, mat x_ref, mat w, mat *H) {
    mat M = of_states(rows, O), slope, bend;
    *H = zeros(rows, NX);
    EACH(k, N_PHI) {
        mat m = zeros(1, NX), h = m;
        if (NETWORK) {
            const double *v = OBSERVABLES_W + k * NX;
            double a = OBSERVABLES_B[k] + dot(v, x.a), b = OBSERVABLES_B[k] + dot(v, x_ref.a);
            double d = a - b + copysign(1e-300, a - b);
            m = scaled(tanh(d) / d * (1.0 - tanh(a) * tanh(b)), of(1, NX, v));
            h = scaled(-(tanh(a) + tanh(b)) * dot(m.a, w.a), of(1, NX, v));
        }
        EACH(node, NETWORK ? 0 : 5) {
            feature(k, between(x_ref, x, node), &slope, &bend);
            m = plus(m, SHARES[node], slope);
            h = plus(h, SHARES[node], transposed(mul(bend, w)));
        }
        of_feature(k, O, m, &M);
        of_feature(k, O, h, H);
    }
    return M;
}

/* The drift f (NX, 1) and, where J is not NULL, its derivative J (NX, NX), of the model or of its
 * linearisation */
static mat drift(int linear, mat x, mat *J) {
    mat N = of(NX, NX, SLOPE), AN, slope, bend, pre = of(NX, NX, PRE_FEEDBACK), f = mul(N, x);
    mat bent = zeros(NX, NX);
    if (READ_OUT && !linear) f = lift(NX, MODEL_READOUT, x, &N);
    if ((READ_OUT || linear) && J) *J = N;
    if (READ_OUT || linear) return f;
    /* f = N'^+ A N, and the derivative of N''N' f = N''A N by each state */
    mat rate = lift(NZ, RATE, x, &AN);
    lift(NZ, LIFT, x, &N);
    mat onto = inverse(N, 1e-15 * size(N)), rest;
    f = mul(onto, rate);
    rest = plus(rate, -1.0, mul(N, f));
    EACH(k, J ? N_PHI : 0) {
        double share = 0.0;
        feature(k, x, &slope, &bend);
        EACH(i, NZ) share += LIFT[i * N_PSI + NX + k] * rest.a[i];
        bent = plus(bent, share, bend);
        of_feature(k, LIFT, scaled(-1.0, transposed(mul(bend, f))), &AN);
    }
    if (J) *J = plus(mul(onto, plus(AN, 1.0, mul(transposed(onto), bent))), -1.0, pre);
    return plus(f, -1.0, mul(pre, x));
}

/* B(x) (NX, NU), and the derivative J (NX, NX) of B(x) u */
static mat input_matrix(int linear, mat x, mat u, mat *J) {
    mat B = of(NX, NU, MODEL_B);
    *J = zeros(NX, NX);
    EACH(k, linear ? 0 : N_TERMS) {
        mat term = of(NX, NU, INPUT_TERMS_COEFFICIENTS + k * NX * NU), slope = zeros(1, NX);
        EACH(i, NX) slope.a[i] = monomial(TERM_POWERS + k * NX, x, i, -1);
        *J = plus(*J, 1.0, mul(mul(term, u), slope));
        B = plus(B, monomial(TERM_POWERS + k * NX, x, -1, -1), term);
    }
    return B;
}

static mat joined(mat x, mat u) {
    mat y = zeros(NXU, 1);
    put(&y, 0, 0, x);
    put(&y, NX, 0, u);
    return y;
}

static mat state_of(mat y) { return block(y, 0, 0, NX, 1); }

static mat input_of(mat y) { return block(y, NX, 0, NU, 1); }

/* f(x) + B(x) u + w of y = (x, u) and, where J is not NULL, its derivative J (NX, NXU) */
static mat rate_under(int linear, mat y, mat w, mat *J) {
    mat x = state_of(y), slope, by_input, B = input_matrix(linear, x, input_of(y), &by_input);
    w = plus(w, 1.0, drift(linear, x, J ? &slope : NULL));
    if (J) {
        *J = zeros(NX, NXU);
        put(J, 0, 0, plus(slope, 1.0, by_input));
        put(J, 0, NX, B);
    }
    return plus_mul(w, 1.0, B, input_of(y));
}

/* D (NX, NX) with (B(x) - B(x_ref)) u_ref = D (x - x_ref) for y_ref = (x_ref, u_ref) */
static mat input_secant(mat x, mat y_ref) {
    mat D = zeros(NX, NX), J;
    EACH(node, N_TERMS ? 5 : 0) {
        input_matrix(0, between(state_of(y_ref), x, node), input_of(y_ref), &J);
        D = plus(D, SHARES[node], J);
    }
    return D;
}

/* The mean (NX, NX) of the derivative of f + B u_ref between two states */
static mat averaged(mat x, mat y_ref) {
    mat mean = input_secant(x, y_ref), x_ref = state_of(y_ref), J;
    if (READ_OUT) return plus(mean, 1.0, secants(NX, MODEL_READOUT, x, x_ref, x, &J));
    EACH(node, 5) {
        drift(0, between(x_ref, x, node), &J);
        mean = plus(mean, SHARES[node], J);
    }
    return mean;
}

/* --- The sampled Riccati equation --- */

/* P of the discrete equation P = A' P (I + G P)^-1 A + H with A = I + D, in place of H, by
 * doubling (E. K.-W. Chu, H.-Y. Fan, W.-W. Lin, C.-S. Wang, Int. J. Control 77 (2004)); returns 0
 * where A does not vanish. D keeps its digits where the interval is short. */
static int doubled(mat D, mat G, mat *H) {
    mat one = diagonal(D.n, 1.0);
    EACH(step, 40) {
        mat left = plus_mul(one, 1.0, G, *H), more;
        mat Y = solve(left, plus_mul(D, -1.0, G, *H));      /* (I + G H)^-1 A = I + Y */
        left = solve(left, G);
        left = plus_mul(left, 1.0, D, left);
        more = plus(G, 1.0, left);
        G = symmetric(plus_mul(more, 1.0, left, transposed(D)));
        left = plus_mul(*H, 1.0, *H, Y);
        more = plus(*H, 1.0, left);
        *H = symmetric(plus_mul(more, 1.0, transposed(D), left));
        more = plus(D, 1.0, Y);
        D = plus_mul(more, 1.0, D, Y);                      /* A (I + Y) - I */
        if (size(plus(one, 1.0, D)) < 1e-10) return all_finite(*H);
    }
    return 0;
}

/* Replace D, G and P of an equation in continuous time by those of the discrete one with the same
 * solution: a Cayley transform beyond all modes. */
static void discretised(mat *D, mat *G, mat *P, double far) {
    mat one = diagonal(D->n, 1.0), less = plus(*D, -far, one), back = solve(less, one), Y;
    less = plus_mul(transposed(less), 1.0, mul(*P, back), *G);
    Y = solve(less, scaled(2.0 * far, one));
    *G = mul(back, mul(*G, Y));
    *P = mul(Y, mul(*P, back));
    *D = transposed(Y);
}
/* x' = A x + B u with the cost x' Q x + u' R u + 2 u' S x */
typedef struct {
    mat A, B, Q, S, R;
} regulator;

/* The same where the input is held for h, with A less I: of F = (A, B; 0, 0) exp(F h), and the
 * integral of exp(F t)' W exp(F t), by their power series. */
static void hold(double h, regulator *r) {
    mat A = scaled(h, r->A), B = scaled(h, r->B), Q = scaled(h, r->Q), R, S = r->S;
    r->A = A;
    r->B = B;
    r->Q = Q;
    r->R = scaled(h, r->R);
    mat power = A, by_input = B;
    for (int k = 2; k < 18; k++) {
        power = scaled(1.0 / k, mul(A, power));
        by_input = scaled(1.0 / k, mul(A, by_input));
        R = mul(S, B);
        S = scaled(1.0 / k, plus_mul(mul(S, A), 1.0, transposed(B), Q));
        Q = scaled(2.0 / k, symmetric(mul(Q, A)));
        r->A = plus(r->A, 1.0, power);
        r->B = plus(r->B, 1.0, by_input);
        r->R = plus(r->R, 2.0 / k, symmetric(R));
        r->S = plus(r->S, 1.0, S);
        r->Q = plus(r->Q, 1.0, Q);
    }
}

/* From an input that is held for h to one that is held twice as long */
static void hold_twice(regulator *r) {
    mat QA = plus_mul(r->Q, 1.0, r->Q, r->A), SB = mul(r->S, r->B), B_T = transposed(r->B);
    r->R = plus(scaled(2.0, r->R), 2.0, symmetric(SB));
    r->R = plus_mul(r->R, 1.0, B_T, mul(r->Q, r->B));
    r->S = plus_mul(scaled(2.0, r->S), 1.0, r->S, r->A);
    r->S = plus_mul(r->S, 1.0, B_T, QA);
    r->Q = plus_mul(plus(r->Q, 1.0, QA), 1.0, transposed(r->A), QA);
    r->B = plus_mul(scaled(2.0, r->B), 1.0, r->A, r->B);
    r->A = plus_mul(scaled(2.0, r->A), 1.0, r->A, r->A);
}

/* The regulator of x' = A x + B u, of which the first NX states are weighted, with an input that is
 * held for h; the continuous one where h is 0. */
static regulator sampled(mat A, mat B, double h) {
    regulator r = {A, B, zeros(A.n, A.n), zeros(NU, A.n), zeros(NU, NU)};
    int doublings;
    EACH(i, NX) r.Q.a[i * A.n + i] = STATE_WEIGHT[i];
    EACH(i, NU) r.R.a[i * NU + i] = INPUT_WEIGHT[i];
    if (!(h > 0.0)) return r;
    frexp((size(A) + size(B)) * h, &doublings);
    doublings = doublings > -2 ? doublings + 2 : 0;
    hold(ldexp(h, -doublings), &r);
    while (doublings-- > 0) hold_twice(&r);
    return r;
}

/* The gain K (NU, n) of a solution P; returns a status. */
static int gain_of(const regulator *r, int held, mat P, mat *K) {
    mat PA = mul(P, r->A), right = transposed(mul(P, r->B)), inner = r->R, rest = r->Q;
    if (held) inner = plus_mul(inner, 1.0, right, r->B);
    if (held) right = plus_mul(right, 1.0, right, r->A);
    right = plus(right, 1.0, r->S);
    *K = solve(inner, right);
    /* the equation less P on both sides, whose terms shrink with the interval */
    double terms = size(rest) + 2.0 * size(PA);
    rest = plus(rest, 2.0, symmetric(PA));
    PA = scaled(held, mul(transposed(r->A), PA));
    right = mul(transposed(right), *K);
    rest = plus(plus(rest, 1.0, PA), -1.0, right);
    terms += size(right);
    if (!(size(rest) / terms <= TUNING_MAX_RICCATI_RESIDUAL)) return KOOPMAN_RICCATI_INACCURATE;
    right = scaled(1.0 / TUNING_MAX_GAIN, *K);
    return contracts(mul(right, transposed(right))) ? KOOPMAN_OK : KOOPMAN_GAIN_TOO_LARGE;
}

/* The gain K (NU, n) of the regulator of x' = A x + B u with inputs that are held for h, and the
 * transition of its loop; of the continuous one, and A - B K, where h is 0. Returns a status. */
static int riccati(mat A, mat B, double h, mat *K, mat *loop) {
    if (!all_finite(A) || !all_finite(B)) return KOOPMAN_NOT_STABILISABLE;
    regulator r = sampled(A, B, h);
    mat G = mul(r.B, solve(r.R, transposed(r.B))), P = solve(r.R, r.S);
    A = plus_mul(r.A, -1.0, r.B, P);
    P = plus_mul(r.Q, -1.0, transposed(r.S), P);
    if (!(h > 0.0)) discretised(&A, &G, &P, size(r.A) + sqrt(size(G) * size(r.Q)));
    if (!doubled(A, G, &P)) return KOOPMAN_NOT_STABILISABLE;
    int status = gain_of(&r, h > 0.0, P, K);
    *loop = plus_mul(plus(r.A, h > 0.0, diagonal(A.n, 1.0)), -1.0, r.B, *K);
    return status;
}

/* Whether an error with this transition decays, or with e' = loop e where h is 0 */
static int decays(mat loop, double h) {
    if (!all_finite(loop)) return 0;
    if (h > 0.0) return contracts(loop);
    return contracts(plus(diagonal(NX, 1.0), 1.0, sampled(loop, zeros(NX, NU), 1.0).A));
}

/* --- The control law --- */

/* A command within its range, and within its rate of one before */
static mat limited(mat u, const double *previous, double seconds) {
    EACH(i, NU) {
        double reach = isinf(LIMITS_RATE[i]) ? INFINITY : LIMITS_RATE[i] * larger(0.0, seconds);
        u.a[i] = within(u.a[i], LIMITS_LOWER[i], LIMITS_UPPER[i]);
        if (previous) u.a[i] = within(u.a[i], previous[i] - reach, previous[i] + reach);
    }
    return u;
}

/* Of the re-centred law towards y_ref: e = N(x) - N(x_ref), M with e = M (x - x_ref), and loop and
 * push of e' = (A + H C) e + N' B v. */
static void recentred(mat x, mat y_ref, mat w, mat *loop, mat *push, mat *e, mat *M) {
    mat x_ref = state_of(y_ref), u_ref = input_of(y_ref), N, H, J;
    w = plus_mul(w, 1.0, input_matrix(0, x_ref, u_ref, &J), u_ref);
    w = plus_mul(w, -1.0, of(NX, NX, PRE_FEEDBACK), x_ref);
    *M = secants(NZ, LIFT, x, x_ref, w, &H);
    *e = lift(NZ, LIFT, x_ref, &N);
    *e = plus(lift(NZ, LIFT, x, &N), -1.0, *e);
    J = plus(input_secant(x, y_ref), -1.0, of(NX, NX, PRE_FEEDBACK));
    H = plus_mul(H, 1.0, N, J);
    *loop = of(NZ, NZ, MODEL_A);
    put(loop, 0, 0, plus(block(*loop, 0, 0, NZ, NX), 1.0, H));
    *push = mul(N, input_matrix(0, x, u_ref, &J));
}

/* The law u = u_ref - K e of a model towards a target y_ref = (x_ref, u_ref): a command in its
 * units, within its range; returns a status. */
static int law(int linear, const koopman_estimate *from, mat y_ref, double interval, mat *u) {
    mat x = of(NX, 1, from->x), slope = of(NX, NX, SLOPE), K, M, e, loop, push;
    double h = interval / TIME_UNIT;
    int status = KOOPMAN_NOT_STABILISABLE;
    if (CLOSED && !linear) {
        recentred(x, y_ref, of(NX, 1, from->w), &loop, &push, &e, &M);
        status = riccati(loop, push, h, &K, &loop);
    }
    if (status != KOOPMAN_OK) {
        if (!linear) slope = averaged(x, y_ref);
        push = input_matrix(linear, x, input_of(y_ref), &loop);
        M = diagonal(NX, 1.0);
        e = plus(x, -1.0, state_of(y_ref));
        status = riccati(slope, push, h, &K, &loop);
    }
    if (status != KOOPMAN_OK) return status;
    if (!decays(block(mul(loop, M), 0, 0, NX, NX), h)) return KOOPMAN_PREDICTED_UNSTABLE;
    *u = physical_input(plus_mul(input_of(y_ref), -1.0, K, e));
    if (!all_finite(*u)) return KOOPMAN_COMMAND_NOT_FINITE;
    *u = limited(*u, NULL, 0.0);
    return KOOPMAN_OK;
}

/* --- Steady states --- */

/* Minimise |M y - m| for each of `count` matrices in turn, each among the minimisers of those
 * before; fixed variables stay. Of each of these `slope` is the derivative by it of the first
 * |M y - m|^2 / 2 that it changes when the others respond. */
static void minimised(int count, const mat *M, const mat *m, const int *fixed, mat *y,
                      double *slope) {
    mat freedom = zeros(NXU, NXU), moved = freedom;
    int open[NXU];
    EACH(k, NXU) {
        (fixed[k] ? &moved : &freedom)->a[k * NXU + k] = 1.0;
        open[k] = fixed[k];
        slope[k] = 0.0;
    }
    EACH(r, count) {
        double least = STEADY_RANK * size(M[r]);
        mat part = mul(M[r], freedom), onto = inverse(part, least), rest, change;
        *y = plus_mul(*y, 1.0, onto, plus_mul(m[r], -1.0, M[r], *y));
        rest = plus_mul(scaled(-1.0, m[r]), 1.0, M[r], *y);
        moved = plus_mul(moved, -1.0, onto, mul(M[r], moved));
        change = mul(M[r], moved);
        EACH(k, NXU) {
            mat column = block(change, 0, k, change.m, 1);
            if (!open[k] || !(size(column) > least)) continue;
            slope[k] = mul(transposed(rest), column).a[0];
            open[k] = 0;
        }
        freedom = plus_mul(freedom, -1.0, onto, part);
    }
}

/* The same within limits; equal ones make a variable given, which is taken from `start`. */
static mat bounded_least_squares(int count, const mat *M, const mat *m, const double *lower,
                                 const double *upper, mat start) {
    mat y = start, best;
    double slope[NXU];
    int at[NXU], inside = 1;
    EACH(k, NXU) at[k] = lower[k] == upper[k];
    minimised(count, M, m, at, &y, slope);
    EACH(k, NXU) {
        double slack = lower[k] < upper[k] ? STEADY_TOLERANCE : 0.0;
        inside = inside && y.a[k] >= lower[k] - slack && y.a[k] <= upper[k] + slack;
        at[k] = at[k] || y.a[k] < lower[k] || y.a[k] > upper[k];
    }
    EACH(k, NXU) y.a[k] = within(y.a[k], lower[k], upper[k]);
    for (int changes = 0; !inside && changes < STEADY_CHANGES * NXU; changes++) {
        double share = 1.0, most = STEADY_RANK;
        int first = -1;
        best = y;
        minimised(count, M, m, at, &best, slope);
        /* as far as the first limit on the way */
        EACH(k, NXU) {
            double step = best.a[k] - y.a[k], room = (step > 0.0 ? upper : lower)[k] - y.a[k];
            if (at[k] || !(fabs(step) > fabs(room) + STEADY_TOLERANCE)) continue;
            if (first >= 0 && !(room / step < share)) continue;
            share = room / step;
            first = k;
        }
        if (first >= 0) {
            double up = best.a[first] - y.a[first];
            y = plus(y, share, plus(best, -1.0, y));
            y.a[first] = (up > 0.0 ? upper : lower)[first];
            at[first] = 1;
            continue;
        }
        EACH(k, NXU) y.a[k] = within(best.a[k], lower[k], upper[k]);
        /* a variable leaves its limit where that is an improvement */
        EACH(k, NXU) {
            double gain = y.a[k] == lower[k] ? -slope[k] : slope[k];
            if (!at[k] || lower[k] == upper[k] || !(gain > most)) continue;
            most = gain;
            first = k;
        }
        if (first < 0) break;
        at[first] = 0;
    }
    return y;
}

static double largest(mat A) {
    double most = 0.0;
    EACH(k, A.m * A.n) most = larger(most, fabs(A.a[k]));
    return most;
}

/* Move y = (x, u), by Newton's method, to the state of rest under w that is nearest to a goal, with
 * NaN for any value, and of those that are as near to an anchor; returns 0 where there is none
 * within the limits. */
static int steady_state(int linear, mat w, const double *lower, const double *upper,
                        const double *goal, mat anchor, mat *y) {
    mat J, before, M[3], m[3];
    double radius = INFINITY, share = 1.0, small = 0.0, now = 0.0;
    int fresh = 1;
    EACH(k, NXU) y->a[k] = within(y->a[k], lower[k], upper[k]);
    M[1] = m[1] = zeros(NXU, NXU);
    m[1].n = 1;
    EACH(k, NXU) if (!isnan(goal[k])) {
        M[1].a[k * NXU + k] = 1.0;
        m[1].a[k] = goal[k];
    }
    mat wanted = M[1], values = m[1], every = diagonal(NXU, 1.0), found;
    found = rate_under(linear, *y, w, NULL);
    EACH(count, STEADY_STEPS) {
        double low[NXU], high[NXU], length;
        if (fresh) {
            rate_under(linear, *y, w, &J);
            if (!all_finite(J) || !all_finite(found)) return 0;
            small = STEADY_TOLERANCE * size(J);
            before = *y;
            M[0] = J;
            m[0] = plus_mul(scaled(-1.0, found), 1.0, J, *y);
            M[1] = every;
            m[1] = *y;
            if (size(found) > small) before = bounded_least_squares(2, M, m, lower, upper, *y);
            now = size(plus_mul(scaled(-1.0, values), 1.0, wanted, before));
        }
        /* no further from the nearest place of rest than the linearisation has proved to hold */
        EACH(k, NXU) low[k] = larger(lower[k], before.a[k] - radius);
        EACH(k, NXU) high[k] = smaller(upper[k], before.a[k] + radius);
        m[0] = plus_mul(scaled(-1.0, found), 1.0, J, *y);
        M[1] = wanted;
        m[1] = values;
        M[2] = every;
        m[2] = anchor;
        mat best = bounded_least_squares(3, M, m, low, high, before);
        mat step = plus(best, -1.0, *y), back = plus(before, -1.0, *y), left, bend, after;
        double near = size(plus_mul(scaled(-1.0, values), 1.0, wanted, best)), away;
        int ends = 0, resting;
        length = largest(step);
        if (length <= STEADY_TOLERANCE) {
            *y = best;
            return size(plus_mul(found, 1.0, J, step)) <= small;
        }
        if (length >= 0.5 * radius) ends = now - near <= STEADY_FOLD * now;
        if (ends && size(found) <= small) return 1;
        resting = ends || largest(back) > radius;
        if (resting) step = scaled(share, back);
        left = rate_under(linear, plus(*y, 1.0, step), w, NULL);
        bend = plus_mul(plus(left, -1.0, found), -1.0, J, step);
        fresh = all_finite(left);
        if (fresh) {
            mat place = plus(*y, 1.0, step);
            after = place;
            m[0] = plus_mul(scaled(-1.0, bend), 1.0, J, place);
            M[1] = resting ? every : wanted;
            m[1] = mul(M[1], place);
            m[2] = place;
            if (size(bend) > small)
                after = bounded_least_squares(resting ? 2 : 3, M, m, lower, upper, place);
            away = size(plus(after, -1.0, place));
            fresh = away <= STEADY_CURVATURE * size(step) && (resting
                || size(plus_mul(scaled(-1.0, values), 1.0, wanted, after))
                    <= now + STEADY_TOLERANCE + STEADY_PROGRESS * (near - now + away));
            if (fresh) *y = place;
            if (fresh) found = left;
        }
        if (resting) share = fresh ? smaller(1.0, 2.0 * share) : 0.5 * share;
        else radius = fresh ? 2.0 * radius : 0.5 * smaller(length, radius);
    }
    return 0;
}

/* Find the steady state y = (x, u) nearest to a set-point (NC), in its units, under a disturbance,
 * with inputs within their range where there is one near; y is where to begin. Returns 0 where
 * there is none. */
static int find_target(int linear, const double *setpoint, mat w, mat *y) {
    mat none = zeros(NXU, 1), found, J, by_input;
    double lower[NXU], upper[NXU], goal[NXU];
    int inside = 1;
    EACH(k, NXU) {
        goal[k] = NAN;
        lower[k] = -INFINITY;
        upper[k] = INFINITY;
    }
    EACH(i, NC) {
        int k = CONTROLLED[i];
        goal[k] = y->a[k] = (setpoint[i] - STATES_CENTER[k]) / STATES_SCALE[k];
    }
    if (CONTROLS_ALL) {
        put(y, NX, 0, zeros(NU, 1));
        J = input_matrix(linear, state_of(*y), zeros(NU, 1), &by_input);
        put(y, NX, 0, scaled(-1.0, mul(inverse(J, 1e-15 * size(J)),
                                       rate_under(linear, *y, w, NULL))));
    }
    if (!(CONTROLS_ALL && size(rate_under(linear, *y, w, NULL)) <= STEADY_TOLERANCE)
            && !steady_state(linear, w, lower, upper, goal, none, y)) return 0;
    EACH(i, NU) {
        double u = y->a[NX + i];
        lower[NX + i] = LOWER_V[i];
        upper[NX + i] = UPPER_V[i];
        inside = inside && u >= LOWER_V[i] - STEADY_TOLERANCE && u <= UPPER_V[i] + STEADY_TOLERANCE;
    }
    if (NU == 1 || inside) return 1;
    found = *y;
    if (!steady_state(linear, w, lower, upper, goal, none, &found)) return 1;
    /* further off it is on another branch */
    EACH(i, NX) if (!(fabs(found.a[i] - y->a[i]) <= 2.0 * HALF_WIDTH[i] + STEADY_TOLERANCE))
        return 1;
    *y = found;
    return 1;
}

/* --- Estimation --- */

/* w within max_disturbance; none where it is not finite */
static mat bounded(mat w) {
    mat v = mul(of(NU, NX, INPUT_INVERSE), w);
    double share = 0.0;
    EACH(i, NU) share = larger(share, fabs(v.a[i]) / MAX_DISTURBANCE[i]);
    if (share <= 1.0) return w;
    return isfinite(share) ? scaled(1.0 / share, w) : zeros(NX, 1);
}

/* The part of a rate that the estimator takes for a disturbance */
static mat as_disturbance(mat rate) { return bounded(mul(of(NX, NX, ONTO_DISTURBANCES), rate)); }

static int usable(const koopman_estimate *e) {
    return all_finite(of(NX, 1, e->x)) && all_finite(of(NX, 1, e->w))
        && all_finite(of(NP, NP, e->P));
}

/* Predict an estimate under an input, in its units, for some seconds, with or without its
 * covariance; returns 0 where it is lost. `all` is x and, with the covariance, its derivatives by
 * what x and w were. */
static int predicted(int linear, koopman_estimate *e, const double *input, double seconds,
                     int covariance) {
    static const double ahead[] = {0.0, 0.5, 0.5, 1.0}, parts[] = {1.0, 2.0, 2.0, 1.0};
    mat y = joined(of(NX, 1, e->x), input_deviation(input)), w = of(NX, 1, e->w), J;
    rate_under(linear, y, w, &J);
    double duration = seconds / TIME_UNIT;
    double fastest = larger(fastest_rate(block(J, 0, 0, NX, NX)), FASTEST_RATE * TIME_UNIT);
    double count = ceil(duration * fastest / STEP_LENGTH - 1e-9);
    int width = covariance ? WIDTH : 1;
    mat all = zeros(NX, width), rate = all, F = diagonal(NP, 1.0);
    if (!(count <= STEP_MOST)) return 0;
    count = larger(1.0, count);
    if (covariance) put(&all, 0, 1, diagonal(NX, 1.0));
    put(&all, 0, 0, of(NX, 1, e->x));
    EACH(k, count) {
        mat sum = zeros(NX, width);
        EACH(stage, 4) {
            mat at = plus(all, ahead[stage] * duration / count, rate), x;
            put(&y, 0, 0, block(at, 0, 0, NX, 1));
            x = rate_under(linear, y, w, covariance ? &J : NULL);
            if (covariance) rate = mul(block(J, 0, 0, NX, NX), at);
            put(&rate, 0, 0, x);
            EACH(i, covariance ? NX : 0) rate.a[i * width + 1 + NX + i] += 1.0;
            sum = plus(sum, parts[stage], rate);
        }
        all = plus(all, duration / count / 6.0, sum);
    }
    store(block(all, 0, 0, NX, 1), e->x);
    if (covariance) {
        put(&F, 0, 0, block(all, 0, 1, NX, NP));
        F = mul(mul(F, plus(of(NP, NP, e->P), seconds, of(NP, NP, INTENSITY))), transposed(F));
        store(symmetric(F), e->P);
    }
    EACH(i, NX)
        if (!((covariance ? sqrt(e->P[i * NP + i]) : fabs(e->x[i])) <= FARTHEST[i])) return 0;
    return usable(e);
}

/* Take the outputs of a state into account, so many seconds after the last ones. */
static void correct(koopman_estimate *e, mat x, double seconds) {
    mat error = plus(x, -1.0, of(NX, 1, e->x)), gain = zeros(2 * NX, NX);
    double p = exp(-OBSERVER_BANDWIDTH * seconds);
    if (KALMAN) {
        mat P = of(NP, NP, e->P), H = of(NY, NP, H_OUTPUT), R = of(NY, NY, NOISE), HP = mul(H, P);
        mat K = transposed(solve(plus(mul(HP, transposed(H)), 1.0, R), HP));
        mat keep = plus(diagonal(NP, 1.0), -1.0, mul(K, H));
        P = plus(mul(mul(keep, P), transposed(keep)), 1.0, mul(mul(K, R), transposed(K)));
        store(symmetric(P), e->P);
        gain = mul(K, block(H, 0, 0, NY, NX));
    } else {
        put(&gain, 0, 0, diagonal(NX, 1.0 - p * p));
        put(&gain, NX, 0, diagonal(NX, (1.0 - p) * (1.0 - p) / (seconds / TIME_UNIT)));
    }
    error = mul(gain, error);
    add(NX, 1.0, error.a, e->x);
    add(NX, 1.0, error.a + NX, e->w);
    store(bounded(of(NX, 1, e->w)), e->w);
}

/* Start from a measured state: with the disturbance as known, or where u is not NULL the one under
 * which u and the measured disturbances, of the rate `feed`, hold the plant. */
static void restart(int linear, koopman_estimate *e, mat x, const mat *u, mat feed) {
    mat w = e->known ? of(NX, 1, e->w) : zeros(NX, 1);
    if (u) w = as_disturbance(scaled(-1.0, rate_under(
        linear, joined(x, *u), zeros(NX, 1), NULL)));
    if (u && ND > 0) w = as_disturbance(plus(w, -1.0, feed));
    store(x, e->x);
    store(w, e->w);
    store(of(NP, NP, FIRST_COVARIANCE), e->P);
    if (KALMAN) correct(e, x, 0.0);
    e->known = 1;
}

/* The level without regard to a passing reason */
static int settled(const koopman_supervisor *s) {
    return s->resumes >= 0 ? s->resumes : s->level < 0 ? 0 : s->level;
}

/* The level in terms of whose model the estimate is */
static int model_level(const koopman_supervisor *s) {
    return settled(s) < LAWS ? settled(s) : LAWS - 1;
}

/* Transfer an estimate from the model of a level to that of another; the plant's rate stays. */
static void transfer(koopman_estimate *e, int before, int now) {
    mat x = of(NX, 1, e->x), w = of(NX, 1, e->w);
    if (LINEAR[before] == LINEAR[now] || !e->known) return;
    w = plus(plus(w, 1.0, drift(LINEAR[before], x, NULL)), -1.0, drift(LINEAR[now], x, NULL));
    store(as_disturbance(w), e->w);
}

/* --- Time, and inputs under way --- */

/* Seconds since a time; 0 if it never was */
static double since(const koopman_state *s, int64_t time) {
    return time == NEVER ? 0.0 : (double)(s->now - time) / SECOND;
}

/* The last input applied by a time, or the first one, by its place in the queue */
static int applied_by(const koopman_state *s, int64_t time) {
    int k = s->queued - 1;
    while (k > 0 && s->applied_at[k] > time) k--;
    return k;
}

/* The end of the time from begin on, up to end, in which the same input u (NU) acts */
static int64_t piece(const koopman_state *s, int64_t begin, int64_t end, double *u) {
    EACH(k, s->queued) EACH(i, NU) {
        int64_t edge = s->applied_at[k] + DEAD_TIME[i];
        if (k > 0 && edge > begin && edge < end) end = edge;
    }
    EACH(i, NU) u[i] = s->applied[applied_by(s, begin - DEAD_TIME[i])][i];
    return end;
}

/* Append an input in place of those from its time on. */
static void enqueue(koopman_state *s, int64_t time, const double *u) {
    while (s->queued > 0 && s->applied_at[s->queued - 1] >= time) s->queued--;
    if (s->queued == QUEUE) {
        s->queued--;
        EACH(k, s->queued) {
            s->applied_at[k] = s->applied_at[k + 1];
            store(of(NU, 1, s->applied[k + 1]), s->applied[k]);
        }
    }
    s->applied_at[s->queued] = time;
    store(of(NU, 1, u), s->applied[s->queued++]);
}

/* The rate that is due to the measured disturbances */
static mat feed_forward(const koopman_state *s) {
    return mul(of(NX, ND, MODEL_E), deviation(OF_D, s->disturbance));
}

/* Predict an estimate from one time to another; returns 0 where it is lost. For a law, pieces
 * shorter than a share of the fastest time constant act by their mean, the covariance stays, and at
 * most 1,000 of these time constants are predicted; inputs with a dead time up to `acts` are
 * held. */
static int over_pieces(const koopman_state *s, int linear, int64_t begin, int64_t end,
                       double share, int64_t acts, mat held, koopman_estimate *e) {
    double time = 0.0, u[NU];
    mat sum = zeros(NU, 1);
    if (share > 0.0 && (double)(end - begin) / SECOND * FASTEST_RATE > 1000.0) return 0;
    for (int64_t next; begin < end; begin = next) {
        next = piece(s, begin, end, u);
        double seconds = (double)(next - begin) / SECOND, count;
        EACH(i, NU) sum.a[i] += seconds * (DEAD_TIME[i] <= acts ? held.a[i] : u[i]);
        time += seconds;
        if (time * FASTEST_RATE < share && next < end) continue;
        count = share > 0.0 ? larger(1.0, ceil(time * FASTEST_RATE)) : 1.0;
        sum = scaled(1.0 / time, sum);
        EACH(k, count) if (!predicted(linear, e, sum.a, time / count, KALMAN && !(share > 0.0)))
            return 0;
        sum = zeros(NU, 1);
        time = 0.0;
    }
    return 1;
}

/* Predict an estimate up to now, where there is one; as uncertain as at first where it is lost. */
static void predict(const koopman_state *s, double elapsed, koopman_estimate *e) {
    koopman_estimate before = *e;
    int linear = LINEAR[model_level(&s->supervisor)];
    if (!e->known || !(elapsed > 0.0)) return;
    add(NX, 1.0, feed_forward(s).a, e->w);
    if (!over_pieces(s, linear, s->commanded_at, s->now, 0.0, -1, zeros(NU, 1), e)) {
        *e = before;
        store(of(NP, NP, FIRST_COVARIANCE), e->P);
    }
    store(of(NX, 1, before.w), e->w);
}

/* --- Measurements --- */

/* The state of a measurement (NY); what that leaves open is as estimated, or in a steady state. */
static mat position(const koopman_estimate *e, const double *y) {
    mat C = of(NY, NX, OUTPUTS), onto = of(NX, NY, FROM_OUTPUTS), rest = of(NY, 1, y), found;
    mat state = e->known ? physical(OF_X, of(NX, 1, e->x)) : of(NX, 1, STATES_CENTER);
    double lower[NXU], upper[NXU], goal[NXU];
    if (DETERMINED) return mul(onto, rest);
    state = plus(state, 1.0, mul(onto, plus(rest, -1.0, mul(C, state))));
    if (e->known || !RESTS || !all_finite(state)) return state;
    found = joined(deviation(OF_X, state.a), zeros(NU, 1));
    EACH(k, NXU) {
        double beyond = k < NX ? MARGIN[LAWS - 1] * HALF_WIDTH[k] : INFINITY;
        int measured = k < NX && MEASURED[k];
        goal[k] = NAN;
        lower[k] = measured ? found.a[k] : k < NX ? CORNERS[k] - beyond : -beyond;
        upper[k] = measured ? found.a[k] : k < NX ? CORNERS[NX + k] + beyond : beyond;
    }
    if (!steady_state(0, zeros(NX, 1), lower, upper, goal, zeros(NXU, 1), &found)) return state;
    return physical(OF_X, state_of(found));
}

/* Whether a measurement (NY) itself is so far from the training data that no law acts there. */
static int far(const double *y) {
    static const koopman_estimate unknown = {0};
    return distance(position(&unknown, y)) > MARGIN[LAWS - 1];
}

/* Check a measurement (NY) against the last accepted one, of `before`, and renew that in s. */
static int check(const koopman_state *before, koopman_state *s, const double *y, double elapsed,
                 double outside, int *moved) {
    koopman_estimate moves = before->estimate;
    double seconds = since(s, before->accepted_at), worst = 0.0, change[NY];
    const double timeout = SENSOR_STUCK_SENSOR_TIMEOUT;
    mat travel = zeros(NY, 1);
    int first = before->accepted_at == NEVER, still = 0, stuck = 0;
    *moved = 0;
    EACH(i, NY) {
        if (!isfinite(y[i])) return KOOPMAN_NOT_FINITE;
        if (!(y[i] >= SENSOR_LOWER[i] && y[i] <= SENSOR_UPPER[i])) return KOOPMAN_OUTSIDE_SENSOR;
    }
    EACH(i, first ? 0 : NY) {
        change[i] = fabs(y[i] - before->accepted[i]);
        worst = larger(worst, change[i] / (SENSOR_JUMP[i] + SENSOR_RATE[i] * seconds));
        *moved = *moved || (before->jumped && change[i] > SENSOR_JUMP[i]);
        still = still || change[i] == 0.0;
    }
    s->jumped = worst > 1.0;
    if (s->jumped) return KOOPMAN_JUMPED;
    store(of(NY, 1, y), s->accepted);
    s->accepted_at = s->now;
    if (!still) {
        store(of(NX, 1, moves.known ? moves.w : NULL), s->still_w);
    } else if (!(outside > 0.0) && !before->recovering && moves.known) {
        /* elsewhere the model's motion is worth little */
        double place[NY];
        mat x;
        EACH(i, NY) place[i] = before->accepted[i] + before->travel[i];
        x = deviation(OF_X, position(&moves, place).a);
        store(x, moves.x);
        store(of(NX, 1, before->still_w), moves.w);
        predict(before, elapsed, &moves);
        EACH(i, NX) moves.x[i] = (moves.x[i] - x.a[i]) * STATES_SCALE[i];
        travel = mul(of(NY, NX, OUTPUTS), of(NX, 1, moves.x));
    }
    EACH(i, NY) {
        int stays = still && change[i] == 0.0, seen;
        double step = first ? 0.0 : change[i], least = s->resolution[i];
        if (!stays) s->still_since[i] = s->now;
        s->travel[i] = stays ? s->travel[i] + travel.a[i] : 0.0;
        s->resolution[i] = step > 0.0 && (step < least || least == 0.0) ? step : least;
        seen = stays && fabs(s->travel[i]) > larger(0.5 * SENSOR_JUMP[i], 4.0 * s->resolution[i]);
        if (!seen) s->seen_since[i] = s->now;
        if (!seen || s->now - s->seen_since[i] - LONGEST_DEAD_TIME < LONGEST_DEAD_TIME) continue;
        stuck = stuck || (timeout > 0.0 && since(s, s->still_since[i]) > timeout);
    }
    return stuck ? KOOPMAN_FROZEN : KOOPMAN_OK;
}

/* Check measured disturbances (ND), of which one that fails keeps its value. What was estimated
 * while one was lost for long holds the change to its new value already. */
static void disturbed(koopman_state *s, const double *d) {
    mat change = zeros(ND, 1), w = of(NX, 1, s->estimate.w);
    int any = 0;
    EACH(i, ND) {
        double seconds = since(s, s->disturbed_at[i]), step = d[i] - s->disturbance[i];
        double silent = s->disturbed_at[i] == NEVER ? INFINITY : seconds;
        int lost = s->unmeasured[i] && silent * OBSERVER_BANDWIDTH > 1.0;
        s->unmeasured[i] = !(d[i] >= DISTURBANCES_LOWER[i] && d[i] <= DISTURBANCES_UPPER[i])
            || (seconds > 0.0 && fabs(step) > DISTURBANCES_RATE[i] * seconds);
        if (s->unmeasured[i]) continue;
        s->disturbance[i] = d[i];
        s->disturbed_at[i] = s->now;
        change.a[i] = lost ? step / DISTURBANCES_SCALE[i] : 0.0;
        any = any || change.a[i] != 0.0;
    }
    if (!any || !s->estimate.known) return;
    store(as_disturbance(plus(w, -1.0, mul(of(NX, ND, MODEL_E), change))), s->estimate.w);
}

/* Take into account that the last command was not followed, where applied inputs are measured. */
static void follow(koopman_state *s, const double *applied) {
    double *last = s->applied[s->queued - 1];
    EACH(i, all_finite(of(NU, 1, applied)) ? NU : 0)
        last[i] = within(s->command[i], applied[i] - TUNING_TRACKING_TOLERANCE[i],
                         applied[i] + TUNING_TRACKING_TOLERANCE[i]);
}

/* Check a measurement and take it into account: the state that it stands for, in its units, and
 * its distance from the training data. */
static int observe(koopman_state *s, const double *y, double elapsed, double *outside, mat *state)
{
    const koopman_state before = *s;
    koopman_estimate *e = &s->estimate;
    double silent = since(s, before.accepted_at), held[NU] = {0};
    int moved, fault, linear = LINEAR[model_level(&s->supervisor)];
    mat x, u;
    predict(s, elapsed, e);
    *state = position(e, y);
    *outside = distance(*state);
    fault = check(&before, s, y, elapsed, *outside, &moved);
    s->measured_at = s->now;
    /* what the observer made of a sensor that does not move is no disturbance */
    if (fault == KOOPMAN_FROZEN && e->known) store(of(NX, 1, before.still_w), e->w);
    if (fault != KOOPMAN_OK) return fault;
    x = deviation(OF_X, state->a);
    if (!e->known) {
        if (s->commanded) piece(s, s->now, s->now, held);
        u = input_deviation(held);
        restart(linear, e, x, s->commanded ? &u : NULL, feed_forward(s));
        store(of(NX, 1, e->w), s->still_w);     /* what holds the plant at first is no motion */
    } else if (moved || !(elapsed > 0.0) || (*outside > MARGIN[LAWS - 1] && far(y))
               || (silent * OBSERVER_BANDWIDTH > 2.0 && silent > 1.5 * s->interval)) {
        restart(linear, e, x, NULL, x);
    } else {
        correct(e, x, elapsed);
    }
    if (!DETERMINED) *state = position(e, y);
    *outside = distance(*state);
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
        int too_long = (double)(now - next.bad_since) / SECOND > TUNING_HOLD_TIMEOUT;
        if (too_long) next.status = KOOPMAN_HELD_TOO_LONG;
        if (too_long || (s->level == KOOPMAN_SAFE && s->bad_since != NEVER)) {
            next.level = KOOPMAN_SAFE;
            to.passing = 0;
        }
    }
    if (to.passing && from < next.level) next.resumes = from;
    else if (to.passing && next.level == KOOPMAN_HOLD && from > KOOPMAN_HOLD) next.level = from;
    else if (next.level < from && (double)(now - better) / SECOND < TUNING_RECOVERY_TIME)
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

/* Evaluate the law for each input at the state predicted for the time at which it acts; the faster
 * inputs follow the law until then. */
static int evaluate_ahead(const koopman_state *s, int linear, koopman_estimate *e,
                          mat target, double interval, mat *u) {
    const double span = (double)(LONGEST_DEAD_TIME - SHORTEST_DEAD_TIME);
    double count = interval > 0.0 ? smaller(20.0, ceil(span / SECOND / interval)) : 1.0;
    mat held = zeros(NU, 1), later;
    int status;
    if (!s->queued) return law(linear, e, target, interval, u);
    if (!over_pieces(s, linear, s->now, s->now + SHORTEST_DEAD_TIME, 0.1, -1, held, e))
        return KOOPMAN_NOT_PREDICTED;
    status = law(linear, e, target, interval, u);
    held = *u;
    for (int64_t begin = SHORTEST_DEAD_TIME, end; begin < LONGEST_DEAD_TIME; begin = end) {
        if (status != KOOPMAN_OK) return status;
        end = LONGEST_DEAD_TIME;
        EACH(i, NU) if (DEAD_TIME[i] > begin && DEAD_TIME[i] < end) end = DEAD_TIME[i];
        EACH(k, count) {
            int64_t edge = (int64_t)rint(k * (span / count) + (double)SHORTEST_DEAD_TIME);
            if (edge > begin && edge < end) end = edge;
        }
        if (!over_pieces(s, linear, s->now + begin, s->now + end, 0.1, begin, held, e))
            return KOOPMAN_NOT_PREDICTED;
        status = law(linear, e, target, (double)(end - begin) / SECOND, &later);
        EACH(i, NU) if (DEAD_TIME[i] == end) u->a[i] = later.a[i];
        held = limited(later, held.a, (double)(end - begin) / SECOND);
    }
    return status;
}

/* Follow how far the plant has come back where the safe input keeps it outside. */
static void recover(koopman_state *s, int fault, double outside) {
    int was = s->recovering, kept = s->supervisor.bad_since == NEVER
        && s->supervisor.better_since == NEVER;
    s->recovering = 0;
    if (s->supervisor.level != KOOPMAN_SAFE || fault != KOOPMAN_OK) return;
    mat x = deviation(OF_X, position(&s->estimate, s->accepted).a), J;
    mat u = plus(input_deviation(NOMINAL), -1.0, input_deviation(SAFE));
    mat toward = mul(transposed(x), mul(input_matrix(0, x, u, &J), u));
    if (outside > 0.0 ? !(toward.a[0] < 0.0) : !(was && s->led)) return;
    if (!was && !kept) return;
    s->recovering = 1;
    if (was) {
        double change = outside - s->farthest, still = 0.03 * (1.0 + s->farthest);
        if (!(change > still || (change < -still && !s->led))) {
            s->led = s->led || since(s, s->resting_since)
                >= 3.0 * TUNING_RECOVERY_TIME + 2.0 * LONGEST_DEAD_TIME / SECOND;
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
    double share = seconds / TUNING_BUMPLESS_TRANSFER_TIME, offset = 0.0, feed = 0.0;
    EACH(i, NU) {
        s->offset[i] = exp(-share) * (s->offset[i] + share * s->feed[i]);
        s->feed[i] *= exp(-share);
        offset = larger(offset, fabs(s->offset[i]));
        feed = larger(feed, fabs(s->feed[i]));
    }
    s->transferring = share <= 100.0 && offset + feed > 1e-9;
}

/* The input before limits that a law, or none, gives, and the state with it */
static mat automatic(koopman_state *s, int fault, double outside, double elapsed, double interval)
{
    const koopman_supervisor before = s->supervisor;
    request_t to = allowed(&before, outside);
    mat u = zeros(NU, 1), target;
    int targeted = 0, from = model_level(&before), level;
    if (fault != KOOPMAN_OK) to = (request_t){KOOPMAN_HOLD, 1, fault, fault};
    for (;;) {
        s->supervisor = supervised(&before, to, s->now);
        level = s->supervisor.level;
        if (level >= LAWS) break;
        koopman_estimate e = s->estimate;
        int status = KOOPMAN_NO_STEADY_STATE, linear = LINEAR[level], lost;
        transfer(&e, from, level);
        add(NX, 1.0, feed_forward(s).a, e.w);
        target = of(NXU, 1, s->target);
        targeted = find_target(linear, s->setpoint, of(NX, 1, e.w), &target);
        lost = level + 1 < LAWS && !linear && failed_near(of(NX, 1, e.x), target);
        if (targeted) status = evaluate_ahead(s, linear, &e, target, interval, &u);
        if (status != KOOPMAN_OK)
            to = (request_t){level + 1, 0, KOOPMAN_LAW_FAILED, status};
        else if (lost)
            to = (request_t){level + 1, 0, KOOPMAN_LOST_HERE, KOOPMAN_LOST_HERE};
        else break;
    }
    recover(s, fault, outside);
    transfer(&s->estimate, from, model_level(&s->supervisor));
    if (targeted && !CONTROLS_ALL) store(target, s->target);
    if (level < LAWS) {
        if (s->law != level && s->commanded && TUNING_BUMPLESS_TRANSFER_TIME > 0.0) {
            EACH(i, NU) s->offset[i] = s->feed[i] = s->command[i] - u.a[i];
            s->transferring = 1;
        } else if (s->transferring) {
            fade(s, elapsed);
        }
        s->law = level;
        return s->transferring ? plus(u, 1.0, of(NU, 1, s->offset)) : u;
    }
    if (s->supervisor.resumes < 0) s->law = -1;
    if (level == KOOPMAN_HOLD) return of(NU, 1, s->command);
    double led = s->recovering && s->led ? smaller(1.0, 1.25 - s->nearest / s->farthest) : 0.0;
    s->transferring = 0;
    return plus(of(NU, 1, SAFE), led, plus(of(NU, 1, NOMINAL), -1.0, of(NU, 1, SAFE)));
}

/* Command, after a measurement that is accepted or has a fault, or without one. */
static void command(koopman_state *s, int fault, double outside, double elapsed, double interval,
                    double counted) {
    if (!s->commanded) store(of(NU, 1, INPUTS_CENTER), s->command);
    mat u = automatic(s, fault, outside, elapsed, interval);
    store(limited(u, s->commanded ? s->command : NULL, counted), s->command);
    s->commanded = 1;
    s->commanded_at = s->now;
    enqueue(s, s->now, s->command);
}

/* Bring the set-point to the present time; it begins from a state, in its units. */
static void advance(koopman_state *s, mat state, double seconds) {
    EACH(i, NC) {
        int k = CONTROLLED[i];
        double *active = s->setpoint + i, *ramped = s->ramped + i;
        double filter = TUNING_SETPOINT_FILTER_TIME;
        double share = filter > 0.0 ? -expm1(-seconds / filter) : 1.0;
        double ramp = TUNING_SETPOINT_RAMP[i], reach = isinf(ramp) ? INFINITY : ramp * seconds;
        if (!s->active) *active = *ramped = within(state.a[k], STATES_LOWER[k], STATES_UPPER[k]);
        if (isnan(s->requested[i])) s->requested[i] = *active;
        *ramped = within(s->requested[i], *ramped - reach, *ramped + reach);
        *active += share * (*ramped - *active);
    }
    s->active = 1;
}

/* Request a set-point; returns 1 where it is rejected. */
static int request(koopman_state *s, const double *setpoint) {
    EACH(i, NC) if (setpoint[i] < STATES_LOWER[CONTROLLED[i]]
                    || setpoint[i] > STATES_UPPER[CONTROLLED[i]]) return 1;
    EACH(i, NC) if (!isnan(setpoint[i])) s->requested[i] = setpoint[i];
    return 0;
}

void koopman_init(koopman_state *s, const double *applied) {
    *s = (koopman_state){0};
    s->measured_at = s->commanded_at = s->accepted_at = NEVER;
    EACH(i, ND) s->disturbed_at[i] = NEVER;
    store(of(ND, 1, DISTURBANCES_CENTER), s->disturbance);
    store(of(NU, 1, SAFE), s->command);
    s->law = -1;
    s->interval = INFINITY;
    s->supervisor = (koopman_supervisor){-1, -1, KOOPMAN_NO_MEASUREMENT, KOOPMAN_NO_MEASUREMENT,
                                         NEVER, NEVER};
    EACH(i, NC) s->requested[i] = NAN;
    if (!applied || !all_finite(of(NU, 1, applied))) return;
    store(limited(of(NU, 1, applied), NULL, 0.0), s->command);
    s->commanded = 1;
    enqueue(s, NEVER, applied);
}

void koopman_step(koopman_state *s, const koopman_inputs *inputs, koopman_outputs *outputs) {
    int fault = KOOPMAN_OK, received = inputs->received;
    if (inputs->elapsed_ns > 0) s->now += inputs->elapsed_ns;
    outputs->setpoint_rejected = request(s, inputs->setpoint);
    if (received ? !s->commanded || s->measured_at != s->now : s->commanded) {
        double usual = isinf(s->interval) ? 0.0 : s->interval, gap = since(s, s->measured_at);
        double elapsed = since(s, s->commanded_at), outside = NAN, counted = 0.0;
        double interval = received ? smaller(usual, elapsed) : usual;
        mat state;
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
            disturbed(s, inputs->disturbance);
            fault = observe(s, inputs->measured, elapsed, &outside, &state);
            if (fault == KOOPMAN_OK) advance(s, state, counted);
        } else {
            fault = KOOPMAN_NO_MEASUREMENT;
            predict(s, elapsed, &s->estimate);
        }
        command(s, fault, outside, elapsed, interval, counted);
        if (!all_finite(of(NU, 1, s->command)) || (s->estimate.known && !usable(&s->estimate))) {
            *s = before;
            if (received) s->measured_at = s->now;
            s->law = -1;
            s->transferring = s->recovering = s->estimate.known = 0;
            store(zeros(NXU, 1), s->target);
            command(s, KOOPMAN_CALCULATION_FAILED, NAN, elapsed, interval, counted);
        }
    }
    outputs->level = s->commanded ? s->supervisor.level : KOOPMAN_SAFE;
    outputs->status = s->supervisor.status;
    outputs->cause = s->supervisor.cause;
    store(of(NU, 1, s->command), outputs->command);
    store(physical(OF_X, of(NX, 1, s->estimate.x)), outputs->state);
    EACH(i, s->estimate.known ? 0 : NX) outputs->state[i] = NAN;
    EACH(i, NC) outputs->setpoint[i] = s->active ? s->setpoint[i] : NAN;
}
