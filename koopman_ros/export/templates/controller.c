/* SPDX-FileCopyrightText: 2026 The koopman_ros Authors
 * SPDX-License-Identifier: Apache-2.0
 *
@ABOUT@
 *
 * Notation: x state, u input, v = u - u_ref, w disturbance of the rate, y = (x, u), z = N(x) lift;
 * all in scaled deviations from the nominal point, the time in the unit of the model, unless a
 * comment says "in its units". A matrix (m, n) is stored by rows. Each comment ends with the
 * function of koopman_ros that does the same in Python.
 */
#include "controller.h"

#include <math.h>
#include <stddef.h>
#include <string.h>

#if defined(__FINITE_MATH_ONLY__) && __FINITE_MATH_ONLY__ > 0
#error "compile without -ffast-math and -ffinite-math-only: NAN marks a missing value"
#endif

@TABLES@

#define OF_X NX, STATES_CENTER, STATES_SCALE
#define OF_U NU, INPUTS_EFFECT, INPUTS_SCALE
#if ND
#define OF_D ND, DISTURBANCES_CENTER, DISTURBANCES_SCALE
#endif

#define NEVER INT64_MIN
#define OLDEST (-(INT64_MAX / 4))   /* times longer ago, of 73 years, count as this one */
#define SECOND 1e9
#define ENDLESS HUGE_VAL

/* Accuracy of the numerical methods, and the bounds of their loops */
#define ROUNDING 1e-15              /* singular values below this share count as 0 */
#define MAX_SWEEPS 40               /* of rotations, in a pseudo-inverse */
#define MAX_SQUARINGS 50            /* of a matrix, to see whether its powers vanish */
#define MAX_DOUBLINGS 64            /* of the horizon, in a Riccati equation */
#define VANISHED 1e-10              /* norm of a transition that ends these doublings */
#define SERIES_TERMS 18             /* of an exponential */
#define MAX_PREDICTED 1000.0        /* time constants over which a dead time is predicted */
#define MAX_PARTS 20                /* of a dead time, with a law evaluated in each */

#define NODE_COUNT 5                /* of the quadrature between two states */

/* --- Numbers, vectors and matrices --- */

/* larger and smaller pass on a NAN, unlike the comparisons of the language. */
static double larger(double a, double b)
{
    return (isnan(a) || a > b) ? a : b;
}

static double smaller(double a, double b)
{
    return (isnan(a) || a < b) ? a : b;
}

static double within(double value, double lower, double upper)
{
    return smaller(larger(value, lower), upper);
}

static void copy(int n, const double *from, double *to)
{
    for (int k = 0; k < n; k++) {
        to[k] = from[k];
    }
}

static void set_all(int n, double value, double *to)
{
    for (int k = 0; k < n; k++) {
        to[k] = value;
    }
}

static void set_identity(int n, double *A)
{
    set_all(n * n, 0.0, A);
    for (int i = 0; i < n; i++) {
        A[i * n + i] = 1.0;
    }
}

/* y = y + f x */
static void add(int n, double f, const double *x, double *y)
{
    for (int k = 0; k < n; k++) {
        y[k] += f * x[k];
    }
}

static void scale(int n, double f, double *x)
{
    for (int k = 0; k < n; k++) {
        x[k] *= f;
    }
}

static double dot(int n, const double *x, const double *y)
{
    double sum = 0.0;
    for (int k = 0; k < n; k++) {
        sum += x[k] * y[k];
    }
    return sum;
}

/* The Euclidean norm of a vector, the Frobenius norm of a matrix of n entries */
static double norm(int n, const double *x)
{
    return sqrt(dot(n, x, x));
}

static double largest(int n, const double *x)
{
    double most = 0.0;
    for (int k = 0; k < n; k++) {
        most = larger(most, fabs(x[k]));
    }
    return most;
}

static int all_finite(int n, const double *x)
{
    for (int k = 0; k < n; k++) {
        if (!isfinite(x[k])) {
            return 0;
        }
    }
    return 1;
}

/* T (n, m) = A' of A (m, n) */
static void transpose(int m, int n, const double *A, double *T)
{
    for (int i = 0; i < m; i++) {
        for (int j = 0; j < n; j++) {
            T[j * m + i] = A[i * n + j];
        }
    }
}

/* A = (A + A') / 2 */
static void make_symmetric(int n, double *A)
{
    for (int i = 0; i < n; i++) {
        for (int j = 0; j <= i; j++) {
            double mean = 0.5 * (A[i * n + j] + A[j * n + i]);
            A[i * n + j] = mean;
            A[j * n + i] = mean;
        }
    }
}

/* C (m, n) = C + f A B of A (m, k) and B (k, n) */
static void add_product(int m, int k, int n, double f, const double *A, const double *B, double *C)
{
    for (int i = 0; i < m; i++) {
        for (int l = 0; l < k; l++) {
            add(n, f * A[i * k + l], B + l * n, C + i * n);
        }
    }
}

static void multiply(int m, int k, int n, const double *A, const double *B, double *C)
{
    set_all(m * n, 0.0, C);
    add_product(m, k, n, 1.0, A, B, C);
}

/* Copy the matrix (m, n) from A, which has rows of length a, to B, which has rows of length b. */
static void copy_block(int m, int n, int a, const double *A, int b, double *B)
{
    for (int i = 0; i < m; i++) {
        copy(n, A + i * a, B + i * b);
    }
}

static void swap(int n, double *x, double *y)
{
    for (int k = 0; k < n; k++) {
        double kept = x[k];
        x[k] = y[k];
        y[k] = kept;
    }
}

/* B (n, m) = A^-1 B by Gauss-Jordan elimination with pivots; A (n, n) is destroyed.
 * Python: core.solvers._solved */
static void solve(int n, int m, double *A, double *B)
{
    for (int k = 0; k < n; k++) {
        int pivot = k;
        for (int i = k + 1; i < n; i++) {
            if (fabs(A[i * n + k]) > fabs(A[pivot * n + k])) {
                pivot = i;
            }
        }
        swap(n, A + k * n, A + pivot * n);
        swap(m, B + k * m, B + pivot * m);
        for (int i = 0; i < n; i++) {
            if (i != k) {
                double factor = A[i * n + k] / A[k * n + k];
                add(n, -factor, A + k * n, A + i * n);
                add(m, -factor, B + k * m, B + i * m);
            }
        }
    }
    for (int k = 0; k < n; k++) {
        for (int j = 0; j < m; j++) {
            B[k * m + j] /= A[k * n + k];
        }
    }
}

/* Rotate the rows x and y of two matrices: x, y = cosine x - sine y, sine x + cosine y. */
static void rotate(int n, double sine, double cosine, double *x, double *y)
{
    for (int k = 0; k < n; k++) {
        double kept = x[k];
        x[k] = cosine * kept - sine * y[k];
        y[k] = sine * kept + cosine * y[k];
    }
}

/* P (n, m) = A^+ of A (m, n), with singular values up to `least` taken for 0. Rotations make the
 * rows of A orthogonal (M. R. Hestenes, SIAM J. 6 (1958)): with R A = diag(s) V' is
 * A^+ = (R A)' diag(1 / s^2) R.
 * Python: core.arrays.pseudo_inverse */
static void pseudo_inverse(int m, int n, const double *A, double least, double *P)
{
    double X[MAX_INVERTED], R[MAX_INVERTED];
    const int rows = m <= n ? m : n, columns = m <= n ? n : m;
    int rotated = 1;
    if (m <= n) {
        copy(m * n, A, X);
    } else {
        transpose(m, n, A, X);
    }
    set_identity(rows, R);
    for (int sweep = 0; rotated && sweep < MAX_SWEEPS; sweep++) {
        rotated = 0;
        for (int p = 0; p < rows; p++) {
            for (int q = p + 1; q < rows; q++) {
                double *x = X + p * columns, *y = X + q * columns;
                double xx = dot(columns, x, x), yy = dot(columns, y, y), xy = dot(columns, x, y);
                if (fabs(xy) > ROUNDING * sqrt(xx * yy)) {
                    double half = (yy - xx) / (2.0 * xy);
                    double tangent = copysign(1.0, half) / (fabs(half) + sqrt(1.0 + half * half));
                    double cosine = 1.0 / sqrt(1.0 + tangent * tangent);
                    double sine = tangent / sqrt(1.0 + tangent * tangent);
                    rotate(columns, sine, cosine, x, y);
                    rotate(rows, sine, cosine, R + p * rows, R + q * rows);
                    rotated = 1;
                }
            }
        }
    }
    set_all(m * n, 0.0, P);
    for (int p = 0; p < rows; p++) {
        double value = norm(columns, X + p * columns);
        double share = value > least ? 1.0 / (value * value) : 0.0;
        for (int i = 0; i < columns; i++) {
            for (int j = 0; j < rows; j++) {
                double product = X[p * columns + i] * (share * R[p * rows + j]);
                P[m <= n ? i * m + j : j * m + i] += product;
            }
        }
    }
}

/* The size of the fastest mode of A (NX, NX), at most some percent too large: |A^8|^(1/8).
 * Python: core.integration.fastest_rate */
static double fastest_rate(const double *A)
{
    double whole = norm(NX * NX, A), power[NX * NX], root[NX * NX];
    if (!(whole > 0.0 && whole < ENDLESS)) {
        return whole;
    }
    set_all(NX * NX, 0.0, power);
    add(NX * NX, 1.0 / whole, A, power);
    for (int k = 0; k < 3; k++) {
        copy(NX * NX, power, root);
        multiply(NX, NX, NX, root, root, power);
    }
    return whole * pow(norm(NX * NX, power), 0.125);
}

/* Whether all eigenvalues of A (n, n) are within the unit circle: its powers A^2, A^4, ... decide.
 * Python: core.solvers.spectral_radius */
static int contracts(int n, const double *A)
{
    double power[ORDER * ORDER], root[ORDER * ORDER];
    copy(n * n, A, power);
    for (int k = 0; k < MAX_SQUARINGS; k++) {
        double whole = norm(n * n, power);
        if (!(whole >= 1.0 && whole < 1e100)) {
            return whole < 1.0;
        }
        copy(n * n, power, root);
        multiply(n, n, n, root, root, power);
    }
    return 0;
}

/* --- The model dx/dt = f(x) + B(x) u + w --- */

/* Python: model.coordinates.Coordinates.to_deviation */
static void to_deviation(int n, const double *center, const double *unit, const double *value,
                         double *x)
{
    for (int i = 0; i < n; i++) {
        x[i] = (value[i] - center[i]) / unit[i];
    }
}

/* Python: model.coordinates.Coordinates.to_physical */
static void to_physical(int n, const double *center, const double *unit, const double *x,
                        double *value)
{
    for (int i = 0; i < n; i++) {
        value[i] = center[i] + x[i] * unit[i];
    }
}

#if HAS_CURVES
/* The characteristic of input i from `x` to `y`, or from effect to value: piecewise linear, of
 * slope 1 beyond its ends.
 * Python: core.characteristic.Characteristic.effect */
static double mapped(int i, const double *x, const double *y, double at)
{
    int k = CURVES[i], last = CURVES[i + 1] - 1;
    double inside = last > k ? within(at, x[k], x[last]) : at;
    if (last < k || isinf(at)) {
        return at;
    }
    while (k < last - 1 && inside > x[k + 1]) {
        k++;
    }
    return y[k] + (y[k + 1] - y[k]) / (x[k + 1] - x[k]) * (inside - x[k]) + (at - inside);
}

#endif
static void input_to_deviation(const double *u, double *v)
{
#if HAS_CURVES
    double effect[NU];
    for (int i = 0; i < NU; i++) {
        effect[i] = mapped(i, CURVE_VALUES, CURVE_EFFECTS, u[i]);
    }
    to_deviation(OF_U, effect, v);
#else
    to_deviation(OF_U, u, v);
#endif
}

static void input_to_physical(const double *v, double *u)
{
    to_physical(OF_U, v, u);
#if HAS_CURVES
    for (int i = 0; i < NU; i++) {
        u[i] = mapped(i, CURVE_EFFECTS, CURVE_VALUES, u[i]);
    }
#endif
}

#if HAS_STORED_STATES
/* Distance of two states: the largest of their differences, in half-widths of the trained range */
static double distance_between(const double *a, const double *b)
{
    double distance = 0.0;
    for (int i = 0; i < NX; i++) {
        distance = larger(distance, fabs((a[i] - b[i]) / HALF_WIDTH[i]));
    }
    return distance;
}

#endif
/* Distance of a state, in its units, from the training data in half-widths of the trained range.
 * Python: model.lifted_model.LiftedModel.distance */
static double distance_from_data(const double *state)
{
    double x[NX], outside = 0.0;
    to_deviation(OF_X, state, x);
    if (!all_finite(NX, x)) {
        return ENDLESS;
    }
    for (int i = 0; i < NX; i++) {
        double beyond = larger(CORNERS[i] - x[i], x[i] - CORNERS[NX + i]);
        outside = larger(outside, beyond / HALF_WIDTH[i]);
    }
#if N_TRAINING
    double nearest = ENDLESS;
    for (int k = 0; k < N_TRAINING; k++) {
        nearest = smaller(nearest, distance_between(TRAINING_STATES_STATES + k * NX, x));
    }
    outside = larger(outside, nearest - TRAINING_STATES_FILL_DISTANCE);
#endif
    return outside;
}

#if N_LOOPS
/* Whether the law failed in the tested loop nearest to a state and a target.
 * Python: model.training_data.VerifiedLoops.failed_near */
static int failed_near(const double *x, const double *x_ref)
{
    double nearest[2] = {ENDLESS, ENDLESS};
    for (int k = 0; k < N_LOOPS; k++) {
        double start = distance_between(VERIFIED_LOOPS_STARTS + k * NX, x);
        double end = distance_between(VERIFIED_LOOPS_SETPOINTS + k * NX, x_ref);
        int lost = VERIFIED_LOOPS_LOST[k];
        nearest[lost] = smaller(nearest[lost], larger(start, end));
    }
    return nearest[1] < nearest[0];
}

#endif
#if HAS_MONOMIALS
/* Product of the powers of x, differentiated by x_i and x_j where these are not negative.
 * Python: model.observables.Monomials.at */
static double monomial(const int *powers, const double *x, int i, int j)
{
    double value = 1.0;
    for (int k = 0; k < NX; k++) {
        int power = powers[k];
        if (k == i) {
            value *= power;
            power--;
        }
        if (k == j) {
            value *= power;
            power--;
        }
        for (; power > 0; power--) {
            value *= x[k];
        }
    }
    return value;
}

#endif
#if N_PHI
/* Feature k of the lift, phi_k(x); where they are not NULL its slope (NX) and its bend (NX, NX),
 * the first and second derivatives by x. */
#if NETWORK
/* phi_k = tanh(W_k x + b_k) - tanh(b_k).
 * Python: model.observables.NetworkObservables.lift_and_derivatives */
static double feature(int k, const double *x, double *slope, double *bend)
{
    const double *W_k = OBSERVABLES_W + k * NX;
    double h = tanh(OBSERVABLES_B[k] + dot(NX, W_k, x)), s = 1.0 - h * h;
    for (int i = 0; slope && i < NX; i++) {
        slope[i] = s * W_k[i];
    }
    for (int i = 0; bend && i < NX; i++) {
        for (int j = 0; j < NX; j++) {
            bend[i * NX + j] = -2.0 * h * s * W_k[i] * W_k[j];
        }
    }
    return h - AT_ZERO[k];
}
#else
/* phi_k is a monomial of x.
 * Python: model.observables.PolynomialObservables.lift_and_derivatives */
static double feature(int k, const double *x, double *slope, double *bend)
{
    const int *powers = POWERS + k * NX;
    for (int i = 0; slope && i < NX; i++) {
        slope[i] = monomial(powers, x, i, -1);
    }
    for (int i = 0; bend && i < NX; i++) {
        for (int j = 0; j < NX; j++) {
            bend[i * NX + j] = monomial(powers, x, i, j);
        }
    }
    return monomial(powers, x, -1, -1);
}
#endif

#endif
/* O (x, phi(x)) of a matrix O (rows, N_PSI), and where N (rows, NX) is not NULL the derivative by
 * x. With O = LIFT it is z = N(x), with RATE A N(x), with MODEL_READOUT f(x).
 * Python: model.observables.NetworkObservables.lift_and_jacobian */
static void lift(int rows, const double *O, const double *x, double *z, double *N)
{
    for (int i = 0; i < rows; i++) {
        z[i] = dot(NX, O + i * N_PSI, x);
    }
    if (N) {
        copy_block(rows, NX, N_PSI, O, NX, N);
    }
#if N_PHI
    for (int k = 0; k < N_PHI; k++) {
        double slope[NX];
        double value = feature(k, x, N ? slope : NULL, NULL);
        for (int i = 0; i < rows; i++) {
            double weight = O[i * N_PSI + NX + k];
            z[i] += weight * value;
            if (N) {
                add(NX, weight, slope, N + i * NX);
            }
        }
    }
#endif
}

#if HAS_QUADRATURE
/* The state at a node of the quadrature from x_ref to x */
static void at_node(int node, const double *x_ref, const double *x, double *between)
{
    for (int i = 0; i < NX; i++) {
        between[i] = x_ref[i] + NODES[node] * (x[i] - x_ref[i]);
    }
}

#endif
#if HAS_SECANTS
/* The secant M (rows, NX) of O (x, phi) between two states, O psi(x) - O psi(x_ref) =
 * M (x - x_ref), and where H (rows, NX) is not NULL that of the derivative times w.
 * Python: model.observables.NetworkObservables.secants */
static void secants(int rows, const double *O, const double *x, const double *x_ref,
                    const double *w, double *M, double *H)
{
    copy_block(rows, NX, N_PSI, O, NX, M);
    if (H) {
        set_all(rows * NX, 0.0, H);
    }
#if N_PHI
    for (int k = 0; k < N_PHI; k++) {
        double m[NX], h[NX];
        set_all(NX, 0.0, m);
        set_all(NX, 0.0, h);
#if NETWORK
        /* (tanh a - tanh b) / (a - b) = tanh(a - b) / (a - b) (1 - tanh a tanh b) */
        const double *W_k = OBSERVABLES_W + k * NX;
        double a = OBSERVABLES_B[k] + dot(NX, W_k, x), b = OBSERVABLES_B[k] + dot(NX, W_k, x_ref);
        double d = a - b + copysign(1e-300, a - b);
        add(NX, tanh(d) / d * (1.0 - tanh(a) * tanh(b)), W_k, m);
        if (H) {
            add(NX, -(tanh(a) + tanh(b)) * dot(NX, m, w), W_k, h);
        }
#else
        for (int node = 0; node < NODE_COUNT; node++) {
            double between[NX], slope[NX], bend[NX * NX];
            at_node(node, x_ref, x, between);
            (void)feature(k, between, slope, H ? bend : NULL);
            add(NX, SHARES[node], slope, m);
            for (int i = 0; H && i < NX; i++) {
                h[i] += SHARES[node] * dot(NX, bend + i * NX, w);
            }
        }
#endif
        for (int i = 0; i < rows; i++) {
            add(NX, O[i * N_PSI + NX + k], m, M + i * NX);
            if (H) {
                add(NX, O[i * N_PSI + NX + k], h, H + i * NX);
            }
        }
    }
#else
    (void)x;
    (void)x_ref;
    (void)w;
#endif
}

#endif
/* The drift f (NX) and, where J is not NULL, its derivative J (NX, NX), of the linearised model or
 * of the learned one: f = C (x, phi(x)), or f = N'^+ A N(x) - B K x with the pre-feedback K.
 * Python: model.lifted_model.LiftedModel.drift_and_jacobian */
static void drift(int linear, const double *x, double *f, double *J)
{
    if (linear) {
        multiply(NX, NX, 1, SLOPE, x, f);
        if (J) {
            copy(NX * NX, SLOPE, J);
        }
        return;
    }
#if READ_OUT
    lift(NX, MODEL_READOUT, x, f, J);
#else
    double rate[NZ], z[NZ], N[NZ * NX], inverse[NX * NZ];
    lift(NZ, LIFT, x, z, N);
    pseudo_inverse(NZ, NX, N, ROUNDING * norm(NZ * NX, N), inverse);
    if (!J) {
        lift(NZ, RATE, x, rate, NULL);
        multiply(NX, NZ, 1, inverse, rate, f);
    } else {
        /* N'^T N' f = N'^T A N, differentiated by each state */
        double slope[NZ * NX];
        lift(NZ, RATE, x, rate, slope);
        multiply(NX, NZ, 1, inverse, rate, f);
#if N_PHI
        double left[NZ], bent[NX * NX], bend[NX * NX], transposed[NZ * NX];
        copy(NZ, rate, left);
        add_product(NZ, NX, 1, -1.0, N, f, left);
        set_all(NX * NX, 0.0, bent);
        for (int k = 0; k < N_PHI; k++) {
            double share = 0.0, along[NX];
            (void)feature(k, x, NULL, bend);
            multiply(NX, NX, 1, bend, f, along);
            for (int i = 0; i < NZ; i++) {
                share += LIFT[i * N_PSI + NX + k] * left[i];
                add(NX, -LIFT[i * N_PSI + NX + k], along, slope + i * NX);
            }
            add(NX * NX, share, bend, bent);
        }
        transpose(NX, NZ, inverse, transposed);
        add_product(NZ, NX, NX, 1.0, transposed, bent, slope);
#endif
        multiply(NX, NZ, NX, inverse, slope, J);
#if HAS_PRE_FEEDBACK
        add(NX * NX, -1.0, PRE_FEEDBACK, J);
#endif
    }
#if HAS_PRE_FEEDBACK
    add_product(NX, NX, 1, -1.0, PRE_FEEDBACK, x, f);
#endif
#endif
}

/* B(x) (NX, NU), and where J (NX, NX) is not NULL the derivative of B(x) u.
 * Python: model.lifted_model.LiftedModel.input_matrix */
static void input_matrix(int linear, const double *x, const double *u, double *B, double *J)
{
    copy(NX * NU, MODEL_B, B);
    if (J) {
        set_all(NX * NX, 0.0, J);
    }
#if N_TERMS
    for (int k = 0; !linear && k < N_TERMS; k++) {
        const double *term = INPUT_TERMS_COEFFICIENTS + k * NX * NU;
        const int *powers = TERM_POWERS + k * NX;
        add(NX * NU, monomial(powers, x, -1, -1), term, B);
        for (int i = 0; J && i < NX; i++) {
            for (int j = 0; j < NX; j++) {
                J[i * NX + j] += dot(NU, term + i * NU, u) * monomial(powers, x, j, -1);
            }
        }
    }
#else
    (void)linear;
    (void)x;
    (void)u;
#endif
}

/* dx (NX) = f(x) + B(x) u + w of y = (x, u) and, where J is not NULL, its derivative (NX, NXU).
 * Python: model.lifted_model.LiftedModel.rate_under */
static void state_rate(int linear, const double *y, const double *w, double *dx, double *J)
{
    double B[NX * NU], slope[NX * NX], by_input[NX * NX];
    drift(linear, y, dx, J ? slope : NULL);
    input_matrix(linear, y, y + NX, B, J ? by_input : NULL);
    add(NX, 1.0, w, dx);
    add_product(NX, NU, 1, 1.0, B, y + NX, dx);
    if (J) {
        add(NX * NX, 1.0, by_input, slope);
        copy_block(NX, NX, NX, slope, NXU, J);
        copy_block(NX, NU, NU, B, NXU, J + NX);
    }
}

#if HAS_LEARNED_LAW
/* D (NX, NX) with (B(x) - B(x_ref)) u_ref = D (x - x_ref) for y_ref = (x_ref, u_ref).
 * Python: model.input_matrix.InputTerms.averaged_jacobian */
static void input_secant(const double *x, const double *y_ref, double *D)
{
    set_all(NX * NX, 0.0, D);
#if N_TERMS
    for (int node = 0; node < NODE_COUNT; node++) {
        double between[NX], B[NX * NU], J[NX * NX];
        at_node(node, y_ref, x, between);
        input_matrix(0, between, y_ref + NX, B, J);
        add(NX * NX, SHARES[node], J, D);
    }
#else
    (void)x;
    (void)y_ref;
#endif
}

/* A (NX, NX), the mean of the derivative of f + B(x) u_ref from x_ref to x.
 * Python: model.lifted_model.LiftedModel.averaged_drift_jacobian */
static void averaged_jacobian(const double *x, const double *y_ref, double *A)
{
    double part[NX * NX];
    input_secant(x, y_ref, A);
#if READ_OUT
    secants(NX, MODEL_READOUT, x, y_ref, NULL, part, NULL);
    add(NX * NX, 1.0, part, A);
#else
    for (int node = 0; node < NODE_COUNT; node++) {
        double between[NX], f[NX];
        at_node(node, y_ref, x, between);
        drift(0, between, f, part);
        add(NX * NX, SHARES[node], part, A);
    }
#endif
}

#endif
/* --- The Riccati equation of the sampled regulator --- */

/* H (n, n) = P of P = A' P (I + G P)^-1 A + H with A = I + D, by doubling (E. K.-W. Chu,
 * H.-Y. Fan, W.-W. Lin, C.-S. Wang, Int. J. Control 77 (2004)). D keeps its digits where the
 * interval is short. D and G are destroyed; returns 0 where A does not vanish. With
 * W = (I + G H)^-1:
 *     A <- A W A,  G <- G + A W G A',  H <- H + A' H W A. */
static int solve_by_doubling(int n, double *D, double *G, double *H)
{
    for (int step = 0; step < MAX_DOUBLINGS; step++) {
        double left[ORDER * ORDER], Y[ORDER * ORDER], right[ORDER * 2 * ORDER];
        double Dt[ORDER * ORDER], whole[ORDER * ORDER];
        set_identity(n, left);
        add_product(n, n, n, 1.0, G, H, left);
        copy(n * n, D, Y);
        add_product(n, n, n, -1.0, G, H, Y);
        copy_block(n, n, n, Y, 2 * n, right);
        copy_block(n, n, n, G, 2 * n, right + n);
        solve(n, 2 * n, left, right);
        copy_block(n, n, 2 * n, right, n, Y);               /* W A = I + Y */
        copy_block(n, n, 2 * n, right + n, n, left);        /* W G */
        transpose(n, n, D, Dt);
        copy(n * n, left, whole);
        add_product(n, n, n, 1.0, D, left, whole);          /* A W G */
        add(n * n, 1.0, whole, G);
        add_product(n, n, n, 1.0, whole, Dt, G);
        make_symmetric(n, G);
        copy(n * n, H, left);
        add_product(n, n, n, 1.0, H, Y, left);              /* H W A */
        add(n * n, 1.0, left, H);
        add_product(n, n, n, 1.0, Dt, left, H);
        make_symmetric(n, H);
        copy(n * n, D, left);
        add(n * n, 1.0, Y, D);
        add_product(n, n, n, 1.0, left, Y, D);              /* A (I + Y) - I */
        set_identity(n, whole);
        add(n * n, 1.0, D, whole);
        if (norm(n * n, whole) < VANISHED) {
            return all_finite(n * n, H);
        }
    }
    return 0;
}

/* Replace D, G and P of an equation in continuous time by those of the discrete one with the same
 * solution: a Cayley transform at `far`, beyond all modes. */
static void to_discrete(int n, double *D, double *G, double *P, double far)
{
    double less[ORDER * ORDER], back[ORDER * ORDER], Y[ORDER * ORDER], product[ORDER * ORDER];
    copy(n * n, D, less);
    for (int i = 0; i < n; i++) {
        less[i * n + i] -= far;
    }
    transpose(n, n, less, product);
    set_identity(n, back);
    solve(n, n, less, back);
    multiply(n, n, n, P, back, less);
    add_product(n, n, n, 1.0, less, G, product);
    set_identity(n, Y);
    scale(n * n, 2.0 * far, Y);
    solve(n, n, product, Y);
    multiply(n, n, n, G, Y, less);
    multiply(n, n, n, back, less, G);
    multiply(n, n, n, P, back, less);
    multiply(n, n, n, Y, less, P);
    transpose(n, n, Y, D);
}

/* x' = A x + B u with the cost x' Q x + u' R u + 2 u' S x, for n states */
typedef struct {
    double A[ORDER * ORDER], B[ORDER * NU], Q[ORDER * ORDER], S[NU * ORDER], R[NU * NU];
} regulator;

/* Replace A by exp(A h) - I, B by its integral, and the cost by that over h under a held input, by
 * the power series in h. */
static void over_interval(int n, double h, regulator *r)
{
    double A[ORDER * ORDER], B[ORDER * NU], Q[ORDER * ORDER], S[NU * ORDER], R[NU * NU];
    double power[ORDER * ORDER], forced[ORDER * NU], next[ORDER * ORDER], Bt[NU * ORDER];
    scale(n * n, h, r->A);
    scale(n * NU, h, r->B);
    scale(n * n, h, r->Q);
    scale(NU * NU, h, r->R);
    copy(n * n, r->A, A);
    copy(n * NU, r->B, B);
    copy(n * n, r->Q, Q);
    copy(NU * n, r->S, S);
    copy(n * n, A, power);
    copy(n * NU, B, forced);
    transpose(n, NU, B, Bt);
    for (int k = 2; k < SERIES_TERMS; k++) {
        multiply(n, n, n, A, power, next);
        copy(n * n, next, power);
        scale(n * n, 1.0 / k, power);
        multiply(n, n, NU, A, forced, next);
        copy(n * NU, next, forced);
        scale(n * NU, 1.0 / k, forced);
        multiply(NU, n, NU, S, B, R);
        make_symmetric(NU, R);
        multiply(NU, n, n, S, A, next);
        add_product(NU, n, n, 1.0, Bt, Q, next);
        copy(NU * n, next, S);
        scale(NU * n, 1.0 / k, S);
        multiply(n, n, n, Q, A, next);
        copy(n * n, next, Q);
        make_symmetric(n, Q);
        scale(n * n, 2.0 / k, Q);
        add(n * n, 1.0, power, r->A);
        add(n * NU, 1.0, forced, r->B);
        add(NU * NU, 2.0 / k, R, r->R);
        add(NU * n, 1.0, S, r->S);
        add(n * n, 1.0, Q, r->Q);
    }
}

/* From an input that is held for h to one that is held twice as long, with A less I */
static void double_interval(int n, regulator *r)
{
    double QA[ORDER * ORDER], SB[NU * NU], Bt[NU * ORDER], At[ORDER * ORDER];
    double product[ORDER * ORDER];
    copy(n * n, r->Q, QA);
    add_product(n, n, n, 1.0, r->Q, r->A, QA);
    multiply(NU, n, NU, r->S, r->B, SB);
    make_symmetric(NU, SB);
    transpose(n, NU, r->B, Bt);
    transpose(n, n, r->A, At);
    scale(NU * NU, 2.0, r->R);
    add(NU * NU, 2.0, SB, r->R);
    multiply(n, n, NU, r->Q, r->B, product);
    add_product(NU, n, NU, 1.0, Bt, product, r->R);
    multiply(NU, n, n, r->S, r->A, product);
    scale(NU * n, 2.0, r->S);
    add(NU * n, 1.0, product, r->S);
    add_product(NU, n, n, 1.0, Bt, QA, r->S);
    add(n * n, 1.0, QA, r->Q);
    add_product(n, n, n, 1.0, At, QA, r->Q);
    multiply(n, n, NU, r->A, r->B, product);
    scale(n * NU, 2.0, r->B);
    add(n * NU, 1.0, product, r->B);
    multiply(n, n, n, r->A, r->A, product);
    scale(n * n, 2.0, r->A);
    add(n * n, 1.0, product, r->A);
}

/* The regulator of x' = A x + B u, of which the first NX states are weighted, with an input that
 * is held for h; the continuous one where h is 0.
 * Python: core.solvers.over_interval */
static void make_regulator(int n, const double *A, const double *B, double h, regulator *r)
{
    int doublings;
    copy(n * n, A, r->A);
    copy(n * NU, B, r->B);
    set_all(n * n, 0.0, r->Q);
    set_all(NU * n, 0.0, r->S);
    set_all(NU * NU, 0.0, r->R);
    for (int i = 0; i < NX; i++) {
        r->Q[i * n + i] = STATE_WEIGHT[i];
    }
    for (int i = 0; i < NU; i++) {
        r->R[i * NU + i] = INPUT_WEIGHT[i];
    }
    if (h > 0.0) {
        (void)frexp((norm(n * n, A) + norm(n * NU, B)) * h, &doublings);
        doublings = doublings > -2 ? doublings + 2 : 0;
        over_interval(n, ldexp(h, -doublings), r);
        for (; doublings > 0; doublings--) {
            double_interval(n, r);
        }
    }
}

/* The gain K (NU, n) = (R + B'P B)^-1 (B'P A + S) of a solution P, in continuous time
 * R^-1 (B'P + S); returns a status. The residual is that of the equation less P on both sides,
 *     A'P + P A + A'P A - (B'P A + S)' K + Q = 0 with A less I,
 * whose terms shrink with the interval. */
static int feedback_gain(int n, const regulator *r, int held, const double *P, double *K)
{
    double PA[ORDER * ORDER], PB[ORDER * NU], right[NU * ORDER], inner[NU * NU];
    double rest[ORDER * ORDER], product[ORDER * ORDER], terms;
    multiply(n, n, n, P, r->A, PA);
    multiply(n, n, NU, P, r->B, PB);
    transpose(n, NU, PB, right);
    copy(NU * NU, r->R, inner);
    if (held) {
        add_product(NU, n, NU, 1.0, right, r->B, inner);
        copy(NU * n, right, product);
        add_product(NU, n, n, 1.0, product, r->A, right);
    }
    add(NU * n, 1.0, r->S, right);
    copy(NU * n, right, K);
    solve(NU, n, inner, K);
    transpose(NU, n, right, product);
    multiply(n, NU, n, product, K, rest);
    terms = norm(n * n, r->Q) + 2.0 * norm(n * n, PA) + norm(n * n, rest);
    scale(n * n, -1.0, rest);
    add(n * n, 1.0, r->Q, rest);
    if (held) {
        double At[ORDER * ORDER];
        transpose(n, n, r->A, At);
        add_product(n, n, n, 1.0, At, PA, rest);
    }
    make_symmetric(n, PA);
    add(n * n, 2.0, PA, rest);
    if (!(norm(n * n, rest) / terms <= TUNING_MAX_RICCATI_RESIDUAL)) {
        return CONTROLLER_RICCATI_INACCURATE;
    }
    /* the spectral norm of K is that of K K' */
    transpose(NU, n, K, product);
    scale(NU * n, 1.0 / (TUNING_MAX_GAIN * TUNING_MAX_GAIN), product);
    multiply(NU, n, NU, K, product, inner);
    return contracts(NU, inner) ? CONTROLLER_OK : CONTROLLER_GAIN_TOO_LARGE;
}

/* The gain K (NU, n) of the regulator of x' = A x + B u with inputs that are held for h, and the
 * transition of its loop (n, n); of the continuous one, and A - B K, where h is 0. Returns a
 * status.
 * Python: core.solvers.solve_riccati */
static int solve_riccati(int n, const double *A, const double *B, double h, double *K,
                         double *loop)
{
    regulator r;
    double G[ORDER * ORDER], D[ORDER * ORDER], P[ORDER * ORDER], RS[NU * ORDER], RB[NU * ORDER];
    double weight[NU * NU], St[ORDER * NU];
    int status;
    if (!all_finite(n * n, A) || !all_finite(n * NU, B)) {
        return CONTROLLER_NOT_STABILISABLE;
    }
    /* without the weight S: A - B R^-1 S, Q - S' R^-1 S and G = B R^-1 B' */
    make_regulator(n, A, B, h, &r);
    transpose(n, NU, r.B, RB);
    copy(NU * NU, r.R, weight);
    solve(NU, n, weight, RB);
    multiply(n, NU, n, r.B, RB, G);
    copy(NU * n, r.S, RS);
    copy(NU * NU, r.R, weight);
    solve(NU, n, weight, RS);
    copy(n * n, r.A, D);
    add_product(n, NU, n, -1.0, r.B, RS, D);
    transpose(NU, n, r.S, St);
    copy(n * n, r.Q, P);
    add_product(n, NU, n, -1.0, St, RS, P);
    if (!(h > 0.0)) {
        to_discrete(n, D, G, P, norm(n * n, r.A) + sqrt(norm(n * n, G) * norm(n * n, r.Q)));
    }
    if (!solve_by_doubling(n, D, G, P)) {
        return CONTROLLER_NOT_STABILISABLE;
    }
    status = feedback_gain(n, &r, h > 0.0, P, K);
    copy(n * n, r.A, loop);
    for (int i = 0; h > 0.0 && i < n; i++) {
        loop[i * n + i] += 1.0;
    }
    add_product(n, NU, n, -1.0, r.B, K, loop);
    return status;
}

/* Whether an error with this transition (NX, NX) decays, or with e' = loop e where h is 0.
 * Python: control.laws.riccati.Feedback.growth */
static int decays(const double *loop, double h)
{
    regulator r;
    double none[NX * NU];
    if (!all_finite(NX * NX, loop)) {
        return 0;
    }
    if (h > 0.0) {
        return contracts(NX, loop);
    }
    set_all(NX * NU, 0.0, none);
    make_regulator(NX, loop, none, 1.0, &r);
    for (int i = 0; i < NX; i++) {
        r.A[i * NX + i] += 1.0;
    }
    return contracts(NX, r.A);
}

/* --- The control law u = u_ref - K e --- */

/* Bring a command, in its units, within its range, and within its rate of one before.
 * Python: control.bumpless.limit */
static void limit_command(double *u, const double *previous, double seconds)
{
    for (int i = 0; i < NU; i++) {
        double reach = isinf(LIMITS_RATE[i]) ? ENDLESS : LIMITS_RATE[i] * larger(0.0, seconds);
        u[i] = within(u[i], LIMITS_LOWER[i], LIMITS_UPPER[i]);
        if (previous) {
            u[i] = within(u[i], previous[i] - reach, previous[i] + reach);
        }
    }
}

#if CLOSED
/* The re-centred law towards y_ref: e = N(x) - N(x_ref) = M (x - x_ref), and loop (NZ, NZ) and
 * push (NZ, NU) of e' = (A + H C) e + N'(x) B(x) v.
 * Python: control.laws.riccati.recentred */
static void recentred(const double *x, const double *y_ref, const double *w, double *loop,
                      double *push, double *e, double *M)
{
    double forcing[NX], H[NZ * NX], N[NZ * NX], z_ref[NZ], D[NX * NX], B[NX * NU];
    copy(NX, w, forcing);
    input_matrix(0, y_ref, y_ref + NX, B, NULL);
    add_product(NX, NU, 1, 1.0, B, y_ref + NX, forcing);
    input_secant(x, y_ref, D);
#if HAS_PRE_FEEDBACK
    add_product(NX, NX, 1, -1.0, PRE_FEEDBACK, y_ref, forcing);
    add(NX * NX, -1.0, PRE_FEEDBACK, D);
#endif
    secants(NZ, LIFT, x, y_ref, forcing, M, H);
    lift(NZ, LIFT, y_ref, z_ref, NULL);
    lift(NZ, LIFT, x, e, N);
    add(NZ, -1.0, z_ref, e);
    add_product(NZ, NX, NX, 1.0, N, D, H);
    copy(NZ * NZ, MODEL_A, loop);
    for (int i = 0; i < NZ; i++) {
        add(NX, 1.0, H + i * NX, loop + i * NZ);
    }
    input_matrix(0, x, y_ref + NX, B, NULL);
    multiply(NZ, NX, NU, N, B, push);
}

#endif
/* The law on the error of the state, e = x - x_ref with e' = A(x) e + B(x) v, where A(x) is the
 * averaged Jacobian, or that of the linearised model: its gain K (NU, NX), e, and the transition
 * loop (NX, NX). Returns a status.
 * Python: control.laws.riccati.averaged */
static int law_of_state(int linear, const double *x, const double *y_ref, double h, double *K,
                        double *e, double *loop)
{
    double A[NX * NX], B[NX * NU];
    copy(NX * NX, SLOPE, A);
#if HAS_LEARNED_LAW
    if (!linear) {
        averaged_jacobian(x, y_ref, A);
    }
#endif
    input_matrix(linear, x, y_ref + NX, B, NULL);
    copy(NX, x, e);
    add(NX, -1.0, y_ref, e);
    return solve_riccati(NX, A, B, h, K, loop);
}

/* The law of a model from an estimate (x, w) towards a target y_ref = (x_ref, u_ref): a command in
 * its units, within its range; returns a status. The law is re-centred where the lift is closed;
 * otherwise, and where that fails, it is that of the state.
 * Python: control.laws.riccati.feedback */
static int control_law(int linear, const double *x, const double *w, const double *y_ref,
                       double interval, double *u)
{
    double e[ORDER], K[NU * ORDER], loop[NX * NX], v[NU];
    const double h = interval / TIME_UNIT;
    int n = NX, status;
#if CLOSED
    status = CONTROLLER_NOT_STABILISABLE;
    if (!linear) {
        double A[NZ * NZ], B[NZ * NU], M[NZ * NX], of_lift[NZ * NZ];
        n = NZ;
        recentred(x, y_ref, w, A, B, e, M);
        status = solve_riccati(n, A, B, h, K, of_lift);
        if (status == CONTROLLER_OK) {
            multiply(NX, NZ, NX, of_lift, M, loop);
        }
    }
    if (status != CONTROLLER_OK) {
        n = NX;
        status = law_of_state(linear, x, y_ref, h, K, e, loop);
    }
#else
    (void)w;
    status = law_of_state(linear, x, y_ref, h, K, e, loop);
#endif
    if (status != CONTROLLER_OK) {
        return status;
    }
    if (!decays(loop, h)) {
        return CONTROLLER_PREDICTED_UNSTABLE;
    }
    copy(NU, y_ref + NX, v);
    add_product(NU, n, 1, -1.0, K, e, v);
    input_to_physical(v, u);
    if (!all_finite(NU, u)) {
        return CONTROLLER_COMMAND_NOT_FINITE;
    }
    limit_command(u, NULL, 0.0);
    return CONTROLLER_OK;
}

/* --- Steady states: 0 = f(x) + B(x) u + w --- */

/* Minimise |M y - m| of a matrix M (rows, NXU). */
typedef struct {
    int rows;
    const double *M, *m;
} least_squares;

/* Minimise each of `count` in turn, each among the minimisers of those before; fixed variables
 * stay. Of each of these `slope` is the derivative by it of the first |M y - m|^2 / 2 that it
 * changes when the others respond.
 * Python: core.steady_state._minimised */
static void minimise(int count, const least_squares *ranks, const int *fixed, double *y,
                     double *slope)
{
    double freedom[NXU * NXU], moved[NXU * NXU], part[NXU * NXU], onto[NXU * NXU];
    int open[NXU];
    set_all(NXU * NXU, 0.0, freedom);
    set_all(NXU * NXU, 0.0, moved);
    for (int k = 0; k < NXU; k++) {
        (fixed[k] ? moved : freedom)[k * NXU + k] = 1.0;
        open[k] = fixed[k];
        slope[k] = 0.0;
    }
    for (int r = 0; r < count; r++) {
        const int rows = ranks[r].rows;
        const double *M = ranks[r].M;
        double least = STEADY_RANK * norm(rows * NXU, M), left[NXU], change[NXU * NXU];
        multiply(rows, NXU, NXU, M, freedom, part);
        pseudo_inverse(rows, NXU, part, least, onto);
        copy(rows, ranks[r].m, left);
        add_product(rows, NXU, 1, -1.0, M, y, left);
        add_product(NXU, rows, 1, 1.0, onto, left, y);
        multiply(rows, NXU, 1, M, y, left);
        add(rows, -1.0, ranks[r].m, left);
        multiply(rows, NXU, NXU, M, moved, change);
        add_product(NXU, rows, NXU, -1.0, onto, change, moved);
        multiply(rows, NXU, NXU, M, moved, change);
        for (int k = 0; k < NXU; k++) {
            double squares = 0.0, product = 0.0;
            for (int i = 0; i < rows; i++) {
                squares += change[i * NXU + k] * change[i * NXU + k];
                product += left[i] * change[i * NXU + k];
            }
            if (open[k] && sqrt(squares) > least) {
                slope[k] = product;
                open[k] = 0;
            }
        }
        add_product(NXU, rows, NXU, -1.0, onto, part, freedom);
    }
}

/* The same within limits, in place of y, by active sets; a variable between two equal limits is
 * given.
 * Python: core.steady_state.bounded_least_squares */
static void minimise_within(int count, const least_squares *ranks, const double *lower,
                            const double *upper, double *y)
{
    double slope[NXU], best[NXU];
    int at_limit[NXU], inside = 1;
    for (int k = 0; k < NXU; k++) {
        at_limit[k] = !(lower[k] < upper[k]);
    }
    minimise(count, ranks, at_limit, y, slope);
    for (int k = 0; k < NXU; k++) {
        double slack = lower[k] < upper[k] ? STEADY_TOLERANCE : 0.0;
        inside = inside && y[k] >= lower[k] - slack && y[k] <= upper[k] + slack;
        at_limit[k] = at_limit[k] || y[k] < lower[k] || y[k] > upper[k];
        y[k] = within(y[k], lower[k], upper[k]);
    }
    for (int changes = 0; !inside && changes < STEADY_CHANGES * NXU; changes++) {
        double share = 1.0, most = STEADY_RANK;
        int first = -1;
        copy(NXU, y, best);
        minimise(count, ranks, at_limit, best, slope);
        /* as far as the first limit on the way */
        for (int k = 0; k < NXU; k++) {
            double step = best[k] - y[k], room = (step > 0.0 ? upper : lower)[k] - y[k];
            int beyond = !at_limit[k] && fabs(step) > fabs(room) + STEADY_TOLERANCE;
            if (beyond && (first < 0 || room / step < share)) {
                share = room / step;
                first = k;
            }
        }
        if (first >= 0) {
            double limit = (best[first] > y[first] ? upper : lower)[first];
            add(NXU, -1.0, y, best);
            add(NXU, share, best, y);
            y[first] = limit;
            at_limit[first] = 1;
            continue;
        }
        /* a variable leaves its limit where that is an improvement */
        for (int k = 0; k < NXU; k++) {
            y[k] = within(best[k], lower[k], upper[k]);
            double gain = y[k] > lower[k] ? slope[k] : -slope[k];
            if (at_limit[k] && lower[k] < upper[k] && gain > most) {
                most = gain;
                first = k;
            }
        }
        if (first < 0) {
            break;
        }
        at_limit[first] = 0;
    }
}

/* How far a place is from the goal: |M y - m| */
static double missed(const least_squares *goal, const double *y)
{
    double left[NXU];
    copy(goal->rows, goal->m, left);
    scale(goal->rows, -1.0, left);
    add_product(goal->rows, NXU, 1, 1.0, goal->M, y, left);
    return norm(goal->rows, left);
}

/* Move y = (x, u), by Newton's method, to the steady state under w that is nearest to a goal, with
 * NAN for any value, and of those that are as near to an anchor; returns 0 where there is none
 * within the limits.
 * Python: core.steady_state.steady_state */
static int steady_state(int linear, const double *w, const double *lower, const double *upper,
                        const double *goal, const double *anchor, double *y)
{
    double J[NX * NXU], before[NXU], at_rest[NX], every[NXU * NXU], wanted[NXU * NXU];
    double values[NXU], found[NX], radius = ENDLESS, share = 1.0, small = 0.0, now = 0.0;
    double last[NXU], damping = 1.0;
    least_squares ranks[3], to_goal;
    int fresh = 1;
    set_all(NXU, 0.0, last);
    ranks[0].rows = NX;
    ranks[0].M = J;
    ranks[0].m = at_rest;
    ranks[2].rows = NXU;
    ranks[2].M = every;
    set_identity(NXU, every);
    set_all(NXU * NXU, 0.0, wanted);
    set_all(NXU, 0.0, values);
    for (int k = 0; k < NXU; k++) {
        y[k] = within(y[k], lower[k], upper[k]);
        if (!isnan(goal[k])) {
            wanted[k * NXU + k] = 1.0;
            values[k] = goal[k];
        }
    }
    to_goal.rows = NXU;
    to_goal.M = wanted;
    to_goal.m = values;
    copy(NXU, y, before);
    state_rate(linear, y, w, found, NULL);
    for (int count = 0; count < STEADY_STEPS; count++) {
        double low[NXU], high[NXU], best[NXU], step[NXU], back[NXU], way[NXU], place[NXU];
        double left[NX], bend[NX], length;
        int ends = 0, resting;
        if (fresh) {
            state_rate(linear, y, w, left, J);
            if (!all_finite(NX * NXU, J) || !all_finite(NX, found)) {
                return 0;
            }
            small = STEADY_TOLERANCE * norm(NX * NXU, J);
            copy(NXU, y, before);
            if (norm(NX, found) > small) {
                least_squares nearest[2] = {{NX, J, at_rest}, {NXU, every, y}};
                multiply(NX, NXU, 1, J, y, at_rest);
                add(NX, -1.0, found, at_rest);
                minimise_within(2, nearest, lower, upper, before);
            }
            now = missed(&to_goal, before);
        }
        /* no further from the nearest place of rest than the linearisation has proved to hold */
        for (int k = 0; k < NXU; k++) {
            low[k] = larger(lower[k], before[k] - radius);
            high[k] = smaller(upper[k], before[k] + radius);
        }
        multiply(NX, NXU, 1, J, y, at_rest);
        add(NX, -1.0, found, at_rest);
        ranks[1] = to_goal;
        ranks[2].m = anchor;
        copy(NXU, before, best);
        minimise_within(3, ranks, low, high, best);
        copy(NXU, best, step);
        add(NXU, -1.0, y, step);
        copy(NXU, before, back);
        add(NXU, -1.0, y, back);
        length = largest(NXU, step);
        if (length <= STEADY_TOLERANCE) {
            copy(NXU, best, y);
            add_product(NX, NXU, 1, 1.0, J, step, found);
            return norm(NX, found) <= small;
        }
        if (length >= 0.5 * radius) {
            ends = now - missed(&to_goal, best) <= STEADY_FOLD * now;
        }
        if (ends && norm(NX, found) <= small) {
            return 1;
        }
        resting = ends || largest(NXU, back) > radius;
        copy(NXU, back, step);
        if (resting) {
            scale(NXU, share, step);
            set_all(NXU, 0.0, way);
        } else {
            copy(NXU, best, way);
            add(NXU, -1.0, before, way);
            if (fresh && largest(NXU, last) > STEADY_TOLERANCE) {
                /* near a goal out of reach, curvature makes the whole way too far: the change
                 * from the way before shows what part of it is right */
                double turned = 1.0 - dot(NXU, way, last) / dot(NXU, last, last);
                damping = smaller(1.0, damping / larger(0.5, turned));
            }
            add(NXU, damping, way, step);
        }
        copy(NXU, y, place);
        add(NXU, 1.0, step, place);
        state_rate(linear, place, w, left, NULL);
        copy(NX, left, bend);
        add(NX, -1.0, found, bend);
        add_product(NX, NXU, 1, -1.0, J, step, bend);
        fresh = all_finite(NX, left);
        if (fresh) {
            double after[NXU], away;
            copy(NXU, place, after);
            if (norm(NX, bend) > small) {
                double along[NXU];
                multiply(NX, NXU, 1, J, place, at_rest);
                add(NX, -1.0, bend, at_rest);
                multiply(NXU, NXU, 1, wanted, place, along);
                ranks[1].M = resting ? every : wanted;
                ranks[1].m = resting ? place : along;
                ranks[2].m = place;
                minimise_within(resting ? 2 : 3, ranks, lower, upper, after);
            }
            add(NXU, -1.0, place, after);
            away = norm(NXU, after);
            add(NXU, 1.0, place, after);
            fresh = away <= STEADY_CURVATURE * norm(NXU, step) && (resting
                || missed(&to_goal, after)
                    <= now + STEADY_TOLERANCE
                        + STEADY_PROGRESS * (missed(&to_goal, place) - now + away));
            if (fresh) {
                copy(NXU, place, y);
                copy(NX, left, found);
                copy(NXU, way, last);
            }
        }
        if (resting) {
            share = fresh ? smaller(1.0, 2.0 * share) : 0.5 * share;
        } else {
            radius = fresh ? 2.0 * radius : 0.5 * smaller(length, radius);
        }
    }
    return 0;
}

/* Find the target y = (x_ref, u_ref) of a set-point (NC), in its units: the steady state nearest
 * to it under a disturbance, with inputs within their range where one is found. The search begins
 * at the set-point and, where that fails, from y. Returns 0 where there is none.
 * Python: control.steady_state.steady_state_target */
static int find_target(int linear, const double *setpoint, const double *w, double *y)
{
    double none[NXU], goal[NXU], lower[NXU], upper[NXU];
#if LIMITED_TARGET
    double before[NXU];
    int in_range;
    copy(NXU, y, before);
#endif
    set_all(NXU, 0.0, none);
    set_all(NXU, (double)NAN, goal);
    for (int i = 0; i < NC; i++) {
        int k = CONTROLLED[i];
        y[k] = (setpoint[i] - STATES_CENTER[k]) / STATES_SCALE[k];
        goal[k] = y[k];
    }
    for (int i = 0; i < NX; i++) {
        lower[i] = -LOST * HALF_WIDTH[i];
        upper[i] = LOST * HALF_WIDTH[i];
    }
#if CONTROLS_ALL
    /* linear in the input, which is all that is left to find: u = -B^+ (f + w) */
    double B[NX * NU], inverse[NU * NX], rate[NX];
    set_all(NU, 0.0, y + NX);
    input_matrix(linear, y, y + NX, B, NULL);
    state_rate(linear, y, w, rate, NULL);
    pseudo_inverse(NX, NU, B, ROUNDING * norm(NX * NU, B), inverse);
    add_product(NU, NX, 1, -1.0, inverse, rate, y + NX);
    state_rate(linear, y, w, rate, NULL);
    const int at_rest = norm(NX, rate) <= STEADY_TOLERANCE;
#else
    const int at_rest = 0;
#endif
#if LIMITED_TARGET
    in_range = at_rest;
    for (int i = 0; i < NU; i++) {
        double u = y[NX + i];
        lower[NX + i] = LOWER_V[i];
        upper[NX + i] = UPPER_V[i];
        in_range = in_range && u >= LOWER_V[i] && u <= UPPER_V[i];
    }
    if (!in_range) {
        double held[NXU];
        copy(NXU, y, held);
        if (steady_state(linear, w, lower, upper, goal, none, held)) {
            copy(NXU, held, y);
            return 1;
        }
        if (steady_state(linear, w, lower, upper, goal, none, before)) {
            copy(NXU, before, y);
            return 1;
        }
    }
#endif
    set_all(NU, -ENDLESS, lower + NX);
    set_all(NU, ENDLESS, upper + NX);
    return at_rest || steady_state(linear, w, lower, upper, goal, none, y);
}

/* --- Estimation of x and w --- */

/* Bring w within max_disturbance; none where it is not finite.
 * Python: estimation.disturbance_observer.DisturbanceObserver.bounded */
static void bound_disturbance(double *w)
{
    double v[NU], share = 0.0;
    multiply(NU, NX, 1, INPUT_INVERSE, w, v);
    for (int i = 0; i < NU; i++) {
        share = larger(share, fabs(v[i]) / MAX_DISTURBANCE[i]);
    }
    if (!isfinite(share)) {
        set_all(NX, 0.0, w);
    } else if (share > 1.0) {
        scale(NX, 1.0 / share, w);
    }
}

/* The part of a rate, in place of it, that the estimator takes for a disturbance.
 * Python: estimation.kalman_filters.ExtendedKalmanFilter.transferred */
static void to_disturbance(double *rate)
{
#if KALMAN
    double projected[NX];
    multiply(NX, NX, 1, ONTO_DISTURBANCES, rate, projected);
    copy(NX, projected, rate);
#endif
    bound_disturbance(rate);
}

static int usable(const controller_estimate *e)
{
#if KALMAN
    if (!all_finite(NP * NP, e->P)) {
        return 0;
    }
#endif
    return all_finite(NX, e->x) && all_finite(NX, e->w);
}

/* Predict an estimate under an input, in its units, for some seconds, by Runge-Kutta steps, with
 * or without its covariance P: with F the derivative of (x, w) by what they were,
 * P = F (P + W t) F'. Returns 0 where it is lost.
 * Python: model.lifted_model.LiftedModel.integrated */
static int predict_estimate(int linear, controller_estimate *e, const double *input,
                            double seconds, int covariance)
{
    static const double ahead[] = {0.0, 0.5, 0.5, 1.0}, parts[] = {1.0, 2.0, 2.0, 1.0};
    double y[NXU], J[NX * NXU], slope[NX * NX], first[NX];
    /* x and, with the covariance, its derivatives by what x and w were: (NX, WIDTH) */
    double all[NX * WIDTH], rate[NX * WIDTH], sum[NX * WIDTH], at[NX * WIDTH];
    const int width = covariance ? WIDTH : 1;
    const double duration = seconds / TIME_UNIT;
    double steps;
    int count;
    copy(NX, e->x, y);
    input_to_deviation(input, y + NX);
    state_rate(linear, y, e->w, first, J);
    copy_block(NX, NX, NXU, J, NX, slope);
    steps = ceil(duration * larger(fastest_rate(slope), FASTEST_RATE * TIME_UNIT) / STEP_LENGTH
                 - 1e-9);
    if (!(steps <= STEP_MOST)) {
        return 0;
    }
    count = steps > 1.0 ? (int)steps : 1;
    set_all(NX * width, 0.0, all);
    set_all(NX * width, 0.0, rate);
    for (int i = 0; i < NX; i++) {
        all[i * width] = e->x[i];
        if (covariance) {
            all[i * width + 1 + i] = 1.0;
        }
    }
    for (int k = 0; k < count; k++) {
        set_all(NX * width, 0.0, sum);
        for (int stage = 0; stage < 4; stage++) {
            copy(NX * width, all, at);
            add(NX * width, ahead[stage] * duration / count, rate, at);
            for (int i = 0; i < NX; i++) {
                y[i] = at[i * width];
            }
            state_rate(linear, y, e->w, first, covariance ? J : NULL);
            if (covariance) {
                copy_block(NX, NX, NXU, J, NX, slope);
                multiply(NX, NX, width, slope, at, rate);
            }
            for (int i = 0; i < NX; i++) {
                rate[i * width] = first[i];
                if (covariance) {
                    rate[i * width + 1 + NX + i] += 1.0;
                }
            }
            add(NX * width, parts[stage], rate, sum);
        }
        add(NX * width, duration / count / 6.0, sum, all);
    }
    for (int i = 0; i < NX; i++) {
        e->x[i] = all[i * width];
    }
#if KALMAN
    if (covariance) {
        double F[NP * NP], Ft[NP * NP], grown[NP * NP], product[NP * NP];
        set_identity(NP, F);
        copy_block(NX, NP, WIDTH, all + 1, NP, F);
        transpose(NP, NP, F, Ft);
        copy(NP * NP, e->P, grown);
        add(NP * NP, seconds, INTENSITY, grown);
        multiply(NP, NP, NP, F, grown, product);
        multiply(NP, NP, NP, product, Ft, e->P);
        make_symmetric(NP, e->P);
        for (int i = 0; i < NX; i++) {
            if (!(sqrt(e->P[i * NP + i]) <= FARTHEST[i])) {
                return 0;
            }
        }
    }
#endif
    for (int i = 0; i < NX; i++) {
        if (!(fabs(e->x[i]) <= FARTHEST[i])) {
            return 0;
        }
    }
    return usable(e);
}

#if KALMAN
/* Correct an estimate by a measured state: K = P H' (H P H' + R)^-1, with the covariance in the
 * form of Joseph, P = (I - K H) P (I - K H)' + K R K'.
 * Python: estimation.kalman_filters.ExtendedKalmanFilter.correct */
static void correct(controller_estimate *e, const double *x, double seconds)
{
    double HP[NY * NP], Ht[NP * NY], inner[NY * NY], K[NP * NY], Kt[NY * NP], H_x[NY * NX];
    double keep[NP * NP], keep_t[NP * NP], product[NP * NP], error[NX], y[NY], change[NP];
    (void)seconds;
    multiply(NY, NP, NP, H_OUTPUT, e->P, HP);
    transpose(NY, NP, H_OUTPUT, Ht);
    copy(NY * NY, NOISE, inner);
    add_product(NY, NP, NY, 1.0, HP, Ht, inner);
    copy(NY * NP, HP, Kt);
    solve(NY, NP, inner, Kt);
    transpose(NY, NP, Kt, K);
    set_identity(NP, keep);
    add_product(NP, NY, NP, -1.0, K, H_OUTPUT, keep);
    transpose(NP, NP, keep, keep_t);
    multiply(NP, NP, NP, keep, e->P, product);
    multiply(NP, NP, NP, product, keep_t, e->P);
    multiply(NP, NY, NY, K, NOISE, product);
    add_product(NP, NY, NP, 1.0, product, Kt, e->P);
    make_symmetric(NP, e->P);
    copy(NX, x, error);
    add(NX, -1.0, e->x, error);
    copy_block(NY, NX, NP, H_OUTPUT, NX, H_x);
    multiply(NY, NX, 1, H_x, error, y);
    multiply(NP, NY, 1, K, y, change);
    add(NX, 1.0, change, e->x);
    add(NX, 1.0, change + NX, e->w);
    bound_disturbance(e->w);
}
#else
/* Correct an estimate by a measured state, `seconds` after the one before. With
 * p = exp(-bandwidth t) x moves by (1 - p^2) of its error, w by (1 - p)^2 / t of it.
 * Python: estimation.disturbance_observer.DisturbanceObserver.correct */
static void correct(controller_estimate *e, const double *x, double seconds)
{
    double p = exp(-OBSERVER_BANDWIDTH * seconds);
    for (int i = 0; i < NX; i++) {
        double error = x[i] - e->x[i];
        e->x[i] += (1.0 - p * p) * error;
        e->w[i] += (1.0 - p) * (1.0 - p) / (seconds / TIME_UNIT) * error;
    }
    bound_disturbance(e->w);
}
#endif

/* The level without regard to a passing reason.
 * Python: control.supervisor.Supervisor.settled */
static int settled_level(const controller_supervisor *s)
{
    if (s->resumes >= 0) {
        return s->resumes;
    }
    return s->level < 0 ? 0 : s->level;
}

/* The level in terms of whose model the estimate is.
 * Python: control.estimates.StateEstimation.level */
static int model_level(const controller_supervisor *s)
{
    int level = settled_level(s);
    return level < LAWS ? level : LAWS - 1;
}

/* Transfer an estimate from the model of a level to that of another; the plant's rate stays.
 * Python: control.estimates.StateEstimation.transfer_estimate */
static void transfer_estimate(controller_estimate *e, int before, int now)
{
    double f[NX];
    if (LINEAR[before] == LINEAR[now] || !e->known) {
        return;
    }
    drift(LINEAR[before], e->x, f, NULL);
    add(NX, 1.0, f, e->w);
    drift(LINEAR[now], e->x, f, NULL);
    add(NX, -1.0, f, e->w);
    to_disturbance(e->w);
}

/* --- Time, and inputs under way --- */

/* Times are in ns relative to the present call, so at most 0: none overflows, however long the
 * controller runs and whatever elapsed_ns is. */
static int64_t earlier(int64_t time, int64_t elapsed_ns)
{
    if (time == NEVER) {
        return NEVER;
    }
    return time < OLDEST + elapsed_ns ? OLDEST : time - elapsed_ns;
}

/* Bring all times to the present call; less than 0 counts as 0, more than 73 years as these. */
static void advance_clock(controller_state *s, int64_t elapsed_ns)
{
    const int64_t ns = elapsed_ns > -OLDEST ? -OLDEST : elapsed_ns;
    if (elapsed_ns <= 0) {
        return;
    }
    s->measured_at = earlier(s->measured_at, ns);
    s->commanded_at = earlier(s->commanded_at, ns);
    s->accepted_at = earlier(s->accepted_at, ns);
    s->resting_since = earlier(s->resting_since, ns);
    s->supervisor.bad_since = earlier(s->supervisor.bad_since, ns);
    s->supervisor.better_since = earlier(s->supervisor.better_since, ns);
    for (int i = 0; i < NY; i++) {
        s->still_since[i] = earlier(s->still_since[i], ns);
        s->seen_since[i] = earlier(s->seen_since[i], ns);
    }
#if ND
    for (int i = 0; i < ND; i++) {
        s->disturbed_at[i] = earlier(s->disturbed_at[i], ns);
    }
#endif
    for (int k = 0; k < s->queued; k++) {
        s->applied_at[k] = earlier(s->applied_at[k], ns);
    }
}

/* Seconds since a time; 0 if it never was */
static double since(int64_t time)
{
    return time == NEVER ? 0.0 : -(double)time / SECOND;
}

/* The end of the time from begin on, up to end, in which the same input u (NU) acts.
 * Python: estimation.dead_time.AppliedInputs.pieces */
static int64_t acting_input(const controller_state *s, int64_t begin, int64_t end, double *u)
{
    for (int k = 1; k < s->queued; k++) {
        for (int i = 0; i < NU; i++) {
            int64_t edge = s->applied_at[k] + DEAD_TIME[i];
            if (edge > begin && edge < end) {
                end = edge;
            }
        }
    }
    for (int i = 0; i < NU; i++) {
        int k = s->queued - 1;
        while (k > 0 && s->applied_at[k] > begin - DEAD_TIME[i]) {
            k--;
        }
        u[i] = s->applied[k][i];
    }
    return end;
}

/* Append an input in place of those from its time on.
 * Python: estimation.dead_time.AppliedInputs.followed_by */
static void enqueue(controller_state *s, int64_t time, const double *u)
{
    while (s->queued > 0 && s->applied_at[s->queued - 1] >= time) {
        s->queued--;
    }
    if (s->queued == QUEUE) {
        s->queued--;
        for (int k = 0; k < s->queued; k++) {
            s->applied_at[k] = s->applied_at[k + 1];
            copy(NU, s->applied[k + 1], s->applied[k]);
        }
    }
    s->applied_at[s->queued] = time;
    copy(NU, u, s->applied[s->queued]);
    s->queued++;
}

/* Add the rate E d that is due to the measured disturbances.
 * Python: control.estimates.StateEstimation.feed_forward */
static void add_feed_forward(const controller_state *s, double sign, double *w)
{
#if ND
    double d[ND];
    to_deviation(OF_D, s->disturbance, d);
    add_product(NX, ND, 1, sign, MODEL_E, d, w);
#else
    (void)s;
    (void)sign;
    (void)w;
#endif
}

/* Predict an estimate from one time to another; returns 0 where it is lost. For a law, `share`
 * above 0, pieces shorter than that share of the fastest time constant act by their mean, the
 * covariance stays, and at most MAX_PREDICTED of these time constants are predicted; inputs with a
 * dead time up to `acts` are held.
 * Python: control.fallback.FallbackLevel._predicted */
static int predict_over(const controller_state *s, int linear, int64_t begin, int64_t end,
                        double share, int64_t acts, const double *held, controller_estimate *e)
{
    double time = 0.0, u[NU], mean[NU];
    int64_t next;
#if KALMAN
    const int covariance = !(share > 0.0);
#else
    const int covariance = 0;
#endif
    set_all(NU, 0.0, mean);
    if (share > 0.0 && (double)(end - begin) / SECOND * FASTEST_RATE > MAX_PREDICTED) {
        return 0;
    }
    for (; begin < end; begin = next) {
        double seconds;
        int count = 1;
        next = acting_input(s, begin, end, u);
        seconds = (double)(next - begin) / SECOND;
        for (int i = 0; i < NU; i++) {
            mean[i] += seconds * (DEAD_TIME[i] <= acts ? held[i] : u[i]);
        }
        time += seconds;
        if (time * FASTEST_RATE < share && next < end) {
            continue;
        }
        if (share > 0.0 && time * FASTEST_RATE > 1.0) {
            count = (int)ceil(time * FASTEST_RATE);
        }
        scale(NU, 1.0 / time, mean);
        for (int k = 0; k < count; k++) {
            if (!predict_estimate(linear, e, mean, time / count, covariance)) {
                return 0;
            }
        }
        set_all(NU, 0.0, mean);
        time = 0.0;
    }
    return 1;
}

/* Predict an estimate up to now, where there is one; as uncertain as at first where it is lost.
 * Python: control.estimates.StateEstimation._predict */
static void predict_to_now(const controller_state *s, double elapsed, controller_estimate *e)
{
    const controller_estimate before = *e;
    double none[NU];
    if (!e->known || !(elapsed > 0.0)) {
        return;
    }
    set_all(NU, 0.0, none);
    add_feed_forward(s, 1.0, e->w);
    if (!predict_over(s, LINEAR[model_level(&s->supervisor)], s->commanded_at, 0, 0.0, -1, none,
                      e)) {
        *e = before;
#if KALMAN
        copy(NP * NP, FIRST_COVARIANCE, e->P);
#endif
    }
    copy(NX, before.w, e->w);
}

/* Start from a measured state: with the disturbance as known, or where u is not NULL the one under
 * which u and the measured disturbances hold the plant.
 * Python: estimation.disturbance_observer.DisturbanceObserver.restart */
static void restart(const controller_state *s, controller_estimate *e, const double *x,
                    const double *u)
{
    if (!e->known) {
        set_all(NX, 0.0, e->w);
    }
    if (u) {
        double y[NXU], none[NX];
        set_all(NX, 0.0, none);
        copy(NX, x, y);
        copy(NU, u, y + NX);
        state_rate(LINEAR[model_level(&s->supervisor)], y, none, e->w, NULL);
        scale(NX, -1.0, e->w);
        to_disturbance(e->w);
#if ND
        add_feed_forward(s, -1.0, e->w);
        to_disturbance(e->w);
#endif
    }
    copy(NX, x, e->x);
#if KALMAN
    copy(NP * NP, FIRST_COVARIANCE, e->P);
    correct(e, x, 0.0);
#endif
    e->known = 1;
}

/* --- Measurements --- */

/* The state of a measurement (NY), in its units; what that leaves open is as estimated, or in a
 * steady state. The estimate may be NULL.
 * Python: control.estimates.StateEstimation.position */
static void to_state(const controller_estimate *e, const double *y, double *state)
{
#if DETERMINED
    (void)e;
    multiply(NX, NY, 1, FROM_OUTPUTS, y, state);
#else
    double left[NY];
    const int known = e && e->known;
    if (known) {
        to_physical(OF_X, e->x, state);
    } else {
        copy(NX, STATES_CENTER, state);
    }
    copy(NY, y, left);
    add_product(NY, NX, 1, -1.0, OUTPUTS, state, left);
    add_product(NX, NY, 1, 1.0, FROM_OUTPUTS, left, state);
#if RESTS
    if (!known && all_finite(NX, state)) {
        double found[NXU], lower[NXU], upper[NXU], goal[NXU], none[NXU];
        set_all(NXU, 0.0, none);
        set_all(NXU, (double)NAN, goal);
        to_deviation(OF_X, state, found);
        for (int k = 0; k < NX; k++) {
            double beyond = MARGIN[LAWS - 1] * HALF_WIDTH[k];
            lower[k] = MEASURED[k] ? found[k] : CORNERS[k] - beyond;
            upper[k] = MEASURED[k] ? found[k] : CORNERS[NX + k] + beyond;
        }
        for (int i = 0; i < NU; i++) {
            found[NX + i] = 0.0;
            lower[NX + i] = -ENDLESS;
            upper[NX + i] = ENDLESS;
        }
        if (steady_state(0, none, lower, upper, goal, none, found)) {
            to_physical(OF_X, found, state);
        }
    }
#endif
#endif
}

/* Whether a measurement (NY) itself is so far from the training data that no law acts there */
static int is_far(const double *y)
{
    double state[NX];
    to_state(NULL, y, state);
    return distance_from_data(state) > MARGIN[LAWS - 1];
}

/* How far the outputs (NY) move, as the model has it, while the measurement stands still.
 * Python: control.estimates.StateEstimation.observe */
static void expected_travel(const controller_state *s, const controller_estimate *before,
                            const double *last, double elapsed, double *travel)
{
    controller_estimate e = *before;
    double place[NY], state[NX], x[NX];
    for (int i = 0; i < NY; i++) {
        place[i] = last[i] + s->travel[i];
    }
    to_state(&e, place, state);
    to_deviation(OF_X, state, x);
    copy(NX, x, e.x);
    copy(NX, s->still_w, e.w);
    predict_to_now(s, elapsed, &e);
    for (int i = 0; i < NX; i++) {
        x[i] = (e.x[i] - x[i]) * STATES_SCALE[i];
    }
    multiply(NY, NX, 1, OUTPUTS, x, travel);
}

/* Check a measurement (NY) against the last accepted one, and store it if it is accepted; `before`
 * is the estimate without it.
 * Python: estimation.sensor_checks.check */
static int check_measurement(controller_state *s, const controller_estimate *before,
                             const double *y, double elapsed, double outside, int *moved)
{
    const double seconds = since(s->accepted_at), timeout = SENSOR_STUCK_SENSOR_TIMEOUT;
    const int first = s->accepted_at == NEVER;
    double worst = 0.0, change[NY], last[NY], travel[NY];
    int still = 0, stuck = 0;
    *moved = 0;
    for (int i = 0; i < NY; i++) {
        if (!isfinite(y[i])) {
            return CONTROLLER_NOT_FINITE;
        }
        if (!(y[i] >= SENSOR_LOWER[i] && y[i] <= SENSOR_UPPER[i])) {
            return CONTROLLER_OUTSIDE_SENSOR;
        }
        change[i] = first ? 0.0 : fabs(y[i] - s->accepted[i]);
    }
    for (int i = 0; !first && i < NY; i++) {
        worst = larger(worst, change[i] / (SENSOR_JUMP[i] + SENSOR_RATE[i] * seconds));
        *moved = *moved || (s->jumped && change[i] > SENSOR_JUMP[i]);
        still = still || !(change[i] > 0.0);
    }
    s->jumped = worst > 1.0;
    if (s->jumped) {
        return CONTROLLER_JUMPED;
    }
    copy(NY, s->accepted, last);
    copy(NY, y, s->accepted);
    s->accepted_at = 0;
    set_all(NY, 0.0, travel);
    if (!still) {
        set_all(NX, 0.0, s->still_w);
        if (before->known) {
            copy(NX, before->w, s->still_w);
        }
    } else if (!(outside > 0.0) && !s->recovering && before->known) {
        /* elsewhere the model's motion is worth little */
        expected_travel(s, before, last, elapsed, travel);
    }
    for (int i = 0; i < NY; i++) {
        int stays = still && !(change[i] > 0.0), seen;
        double least = s->resolution[i];
        if (!stays) {
            s->still_since[i] = 0;
        }
        s->travel[i] = stays ? s->travel[i] + travel[i] : 0.0;
        if (change[i] > 0.0 && (change[i] < least || !(least > 0.0))) {
            s->resolution[i] = change[i];
        }
        seen = stays && fabs(s->travel[i]) > larger(0.5 * SENSOR_JUMP[i], 4.0 * s->resolution[i]);
        if (!seen) {
            s->seen_since[i] = 0;
        } else if (-s->seen_since[i] - LONGEST_DEAD_TIME >= LONGEST_DEAD_TIME) {
            stuck = stuck || (timeout > 0.0 && since(s->still_since[i]) > timeout);
        }
    }
    return stuck ? CONTROLLER_FROZEN : CONTROLLER_OK;
}

#if ND
/* Check measured disturbances (ND), of which one that fails keeps its value. What was estimated
 * while one was lost for long holds the change to its new value already.
 * Python: control.estimates.StateEstimation.disturbed */
static void accept_disturbances(controller_state *s, const double *d)
{
    double change[ND];
    int any = 0;
    for (int i = 0; i < ND; i++) {
        double step = d[i] - s->disturbance[i], rate = DISTURBANCES_RATE[i];
        double silent = s->disturbed_at[i] == NEVER ? ENDLESS : since(s->disturbed_at[i]);
        double reach = isinf(rate) || isinf(silent) ? ENDLESS : rate * silent;
        int lost = s->unmeasured[i] && silent * OBSERVER_BANDWIDTH > 1.0;
        change[i] = 0.0;
        s->unmeasured[i] = !(d[i] >= DISTURBANCES_LOWER[i] && d[i] <= DISTURBANCES_UPPER[i])
            || fabs(step) > reach;
        if (!s->unmeasured[i]) {
            s->disturbance[i] = d[i];
            s->disturbed_at[i] = 0;
            change[i] = lost ? step / DISTURBANCES_SCALE[i] : 0.0;
            any = any || fabs(change[i]) > 0.0;
        }
    }
    if (any && s->estimate.known) {
        add_product(NX, ND, 1, -1.0, MODEL_E, change, s->estimate.w);
        to_disturbance(s->estimate.w);
    }
}

#endif
/* Take into account that the last command was not followed, where applied inputs are measured.
 * Python: control.estimates.StateEstimation.applied */
static void follow_applied(controller_state *s, const double *applied)
{
    double *last = s->applied[s->queued - 1];
    if (!all_finite(NU, applied)) {
        return;
    }
    for (int i = 0; i < NU; i++) {
        last[i] = within(s->command[i], applied[i] - TUNING_TRACKING_TOLERANCE[i],
                         applied[i] + TUNING_TRACKING_TOLERANCE[i]);
    }
}

/* Check a measurement and take it into account: the state that it stands for, in its units, and
 * its distance from the training data.
 * Python: control.estimates.StateEstimation.observe */
static int observe(controller_state *s, const double *y, double elapsed, double *outside,
                   double *state)
{
    const controller_estimate before = s->estimate;
    controller_estimate *e = &s->estimate;
    const double silent = since(s->accepted_at);
    double still_w[NX], x[NX];
    int moved, fault;
    copy(NX, s->still_w, still_w);
    predict_to_now(s, elapsed, e);
    to_state(e, y, state);
    *outside = distance_from_data(state);
    fault = check_measurement(s, &before, y, elapsed, *outside, &moved);
    s->measured_at = 0;
    if (fault != CONTROLLER_OK) {
        if (fault == CONTROLLER_FROZEN && e->known) {
            /* what the observer made of a sensor that does not move is no disturbance */
            copy(NX, still_w, e->w);
        }
        return fault;
    }
    to_deviation(OF_X, state, x);
    if (!e->known) {
        double u[NU];
        if (s->commanded) {
            double held[NU];
            (void)acting_input(s, 0, 0, held);
            input_to_deviation(held, u);
        }
        restart(s, e, x, s->commanded ? u : NULL);
        copy(NX, e->w, s->still_w);     /* what holds the plant at first is no motion */
    } else if (moved || !(elapsed > 0.0) || (*outside > MARGIN[LAWS - 1] && is_far(y))
               || (silent * OBSERVER_BANDWIDTH > 2.0 && silent > 1.5 * s->interval)) {
        restart(s, e, x, NULL);
    } else {
        correct(e, x, elapsed);
    }
#if !DETERMINED
    to_state(e, y, state);
#endif
    *outside = distance_from_data(state);
    return CONTROLLER_OK;
}

/* --- The control step --- */

/* A level that is asked for, with the reason; a passing one leaves the level settled. */
typedef struct {
    int level, passing, status, cause;
} level_request;

static void ask_for(level_request *to, int level, int passing, int status, int cause)
{
    to->level = level;
    to->passing = passing;
    to->status = status;
    to->cause = cause;
}

/* Fall back at once, and recover when that was possible for long enough.
 * Python: control.supervisor.Supervisor.at */
static void supervise(const controller_supervisor *before, const level_request *request,
                      controller_supervisor *next)
{
    const int from = settled_level(before);
    int level = request->level, passing = request->passing;
    next->resumes = -1;
    next->status = request->status;
    next->cause = request->cause;
    next->bad_since = NEVER;
    next->better_since = NEVER;
    if (level == CONTROLLER_HOLD) {
        next->bad_since = before->bad_since == NEVER ? 0 : before->bad_since;
        const int too_long = since(next->bad_since) > TUNING_HOLD_TIMEOUT;
        if (too_long) {
            next->status = CONTROLLER_HELD_TOO_LONG;
        }
        if (too_long || (before->level == CONTROLLER_SAFE && before->bad_since != NEVER)) {
            level = CONTROLLER_SAFE;
            passing = 0;
        }
    }
    if (passing && from < level) {
        next->resumes = from;
    } else if (passing && level == CONTROLLER_HOLD && from > CONTROLLER_HOLD) {
        level = from;
    } else if (level < from && since(before->better_since) < TUNING_RECOVERY_TIME) {
        level = from;
        next->status = before->status == CONTROLLER_OK ? CONTROLLER_OK : CONTROLLER_RECOVERING;
        next->cause = before->cause;
        next->bad_since = before->bad_since;
        next->better_since = before->better_since == NEVER ? 0 : before->better_since;
    }
    next->level = level;
}

/* The level that the distance from the training data allows; a margin is left at half of it.
 * Python: control.supervisor.Supervisor.allowed */
static void allowed_level(const controller_supervisor *s, double outside, level_request *to)
{
    ask_for(to, 0, 0, CONTROLLER_OK, CONTROLLER_OK);
    for (int k = LAWS - 1; k >= 0 && to->level == 0; k--) {
        int below = k < LAWS - 1 ? k + 1 : CONTROLLER_SAFE;
        double share = settled_level(s) >= below ? 0.5 : 1.0;
        if (outside > 0.0 && outside > share * MARGIN[k]) {
            ask_for(to, below, 0, CONTROLLER_OUTSIDE_TRAINING, CONTROLLER_OUTSIDE_TRAINING);
        }
    }
}

/* Evaluate the law for each input at the state predicted for the time at which it acts; the faster
 * inputs follow the law until then. Returns a status.
 * Python: control.fallback.FallbackLevel.compute */
static int law_after_dead_times(const controller_state *s, int linear, controller_estimate *e,
                                const double *target, double interval, double *u)
{
    const double span = (double)(LONGEST_DEAD_TIME - SHORTEST_DEAD_TIME);
    double held[NU], later[NU];
    int status, count = 1;
    int64_t begin = SHORTEST_DEAD_TIME;
    if (interval > 0.0) {
        count = (int)smaller((double)MAX_PARTS, ceil(span / SECOND / interval));
    }
    set_all(NU, 0.0, held);
    if (s->queued > 0 && !predict_over(s, linear, 0, begin, 0.1, -1, held, e)) {
        return CONTROLLER_NOT_PREDICTED;
    }
    status = control_law(linear, e->x, e->w, target, interval, u);
    copy(NU, u, held);
    while (status == CONTROLLER_OK && s->queued > 0 && begin < LONGEST_DEAD_TIME) {
        int64_t end = LONGEST_DEAD_TIME;
        double seconds;
        for (int i = 0; i < NU; i++) {
            if (DEAD_TIME[i] > begin && DEAD_TIME[i] < end) {
                end = DEAD_TIME[i];
            }
        }
        for (int k = 0; k < count; k++) {
            int64_t edge = (int64_t)rint(k * (span / count) + (double)SHORTEST_DEAD_TIME);
            if (edge > begin && edge < end) {
                end = edge;
            }
        }
        if (!predict_over(s, linear, begin, end, 0.1, begin, held, e)) {
            return CONTROLLER_NOT_PREDICTED;
        }
        seconds = (double)(end - begin) / SECOND;
        status = control_law(linear, e->x, e->w, target, seconds, later);
        if (status == CONTROLLER_OK) {
            for (int i = 0; i < NU; i++) {
                if (DEAD_TIME[i] == end) {
                    u[i] = later[i];
                }
            }
            limit_command(later, held, seconds);
            copy(NU, later, held);
        }
        begin = end;
    }
    return status;
}

/* Follow how far the plant has come back where the safe input keeps it outside.
 * Python: control.step.ControlStep._recovery */
static void follow_recovery(controller_state *s, int fault, double outside)
{
    const int was = s->recovering, kept = s->supervisor.bad_since == NEVER
        && s->supervisor.better_since == NEVER;
    double state[NX], x[NX], nominal[NU], safe[NU], B[NX * NU], toward[NX];
    s->recovering = 0;
    if (s->supervisor.level != CONTROLLER_SAFE || fault != CONTROLLER_OK) {
        return;
    }
    to_state(&s->estimate, s->accepted, state);
    to_deviation(OF_X, state, x);
    input_to_deviation(NOMINAL, nominal);
    input_to_deviation(SAFE, safe);
    add(NU, -1.0, safe, nominal);
    input_matrix(0, x, nominal, B, NULL);
    multiply(NX, NU, 1, B, nominal, toward);
    if (outside > 0.0 ? !(dot(NX, x, toward) < 0.0) : !(was && s->led)) {
        return;
    }
    if (!was && !kept) {
        return;
    }
    s->recovering = 1;
    if (was) {
        double change = outside - s->farthest, still = 0.03 * (1.0 + s->farthest);
        if (!(change > still || (change < -still && !s->led))) {
            s->led = s->led || since(s->resting_since)
                >= 3.0 * TUNING_RECOVERY_TIME + 2.0 * LONGEST_DEAD_TIME / SECOND;
            s->nearest = smaller(s->nearest, outside);
            return;
        }
    }
    s->led = 0;
    s->farthest = outside;
    s->nearest = outside;
    s->resting_since = 0;
}

#if BUMPLESS
/* Let the offset of a bumpless transfer fade with d (1 + t/T) exp(-t/T).
 * Python: control.bumpless.BumplessTransfer.after */
static void fade_offset(controller_state *s, double seconds)
{
    double share = seconds / TUNING_BUMPLESS_TRANSFER_TIME, offset = 0.0, feed = 0.0;
    for (int i = 0; i < NU; i++) {
        s->offset[i] = exp(-share) * (s->offset[i] + share * s->feed[i]);
        s->feed[i] *= exp(-share);
        offset = larger(offset, fabs(s->offset[i]));
        feed = larger(feed, fabs(s->feed[i]));
    }
    s->transferring = share <= 100.0 && offset + feed > 1e-9;
}

#endif
/* Find the level that acts, and where it is that of a law the input u (NU) before limits.
 * Python: control.step.ControlStep._choose */
static void choose_level(controller_state *s, int fault, double outside, double interval,
                         double *u)
{
    const controller_supervisor before = s->supervisor;
    const int from = model_level(&before);
    double target[NXU];
    int targeted = 0, chosen = 0;
    level_request to;
    allowed_level(&before, outside, &to);
    if (fault != CONTROLLER_OK) {
        ask_for(&to, CONTROLLER_HOLD, 1, fault, fault);
    }
    while (!chosen) {
        controller_estimate e = s->estimate;
        supervise(&before, &to, &s->supervisor);
        const int level = s->supervisor.level;
        if (level >= LAWS) {
            chosen = 1;
        } else {
            int status = CONTROLLER_NO_STEADY_STATE;
            transfer_estimate(&e, from, level);
            add_feed_forward(s, 1.0, e.w);
            copy(NXU, s->target, target);
            targeted = find_target(LINEAR[level], s->setpoint, e.w, target);
#if N_LOOPS
            /* a poor law is better than none */
            const int lost = level + 1 < LAWS && !LINEAR[level] && failed_near(e.x, target);
#endif
            if (targeted) {
                status = law_after_dead_times(s, LINEAR[level], &e, target, interval, u);
            }
            if (status != CONTROLLER_OK) {
                ask_for(&to, level + 1, 0, CONTROLLER_LAW_FAILED, status);
#if N_LOOPS
            } else if (lost) {
                ask_for(&to, level + 1, 0, CONTROLLER_LOST_HERE, CONTROLLER_LOST_HERE);
#endif
            } else {
                chosen = 1;
            }
        }
    }
    follow_recovery(s, fault, outside);
    transfer_estimate(&s->estimate, from, model_level(&s->supervisor));
#if !CONTROLS_ALL
    if (targeted) {
        copy(NXU, target, s->target);
    }
#else
    (void)targeted;
#endif
}

/* The input of the level that acts, before limits, in place of that of its law.
 * Python: control.step.ControlStep._act */
static void act(controller_state *s, double elapsed, double *u)
{
    const int level = s->supervisor.level;
    (void)elapsed;
    if (level < LAWS) {
#if BUMPLESS
        if (s->law != level && s->commanded) {
            for (int i = 0; i < NU; i++) {
                s->offset[i] = s->command[i] - u[i];
                s->feed[i] = s->offset[i];
            }
            s->transferring = 1;
        } else if (s->transferring) {
            fade_offset(s, elapsed);
        }
        if (s->transferring) {
            add(NU, 1.0, s->offset, u);
        }
#endif
        s->law = level;
        return;
    }
    if (s->supervisor.resumes < 0) {
        s->law = -1;
    }
    if (level == CONTROLLER_HOLD) {
        copy(NU, s->command, u);
        return;
    }
    double share = s->recovering && s->led ? smaller(1.0, 1.25 - s->nearest / s->farthest) : 0.0;
    s->transferring = 0;
    for (int i = 0; i < NU; i++) {
        u[i] = SAFE[i] + share * (NOMINAL[i] - SAFE[i]);
    }
}

/* Command, after a measurement that is accepted or has a fault, or without one.
 * Python: control.step.ControlStep._command */
static void find_command(controller_state *s, int fault, double outside, double elapsed,
                         double interval, double counted)
{
    double u[NU];
    if (!s->commanded) {
        copy(NU, INPUTS_CENTER, s->command);
    }
    choose_level(s, fault, outside, interval, u);
    act(s, elapsed, u);
    limit_command(u, s->commanded ? s->command : NULL, counted);
    copy(NU, u, s->command);
    s->commanded = 1;
    s->commanded_at = 0;
    enqueue(s, 0, s->command);
}

/* Bring the set-point to the present time; it begins from a state, in its units.
 * Python: control.setpoint.advance */
static void advance_setpoint(controller_state *s, const double *state, double seconds)
{
    const double filter = TUNING_SETPOINT_FILTER_TIME;
    const double share = filter > 0.0 ? -expm1(-seconds / filter) : 1.0;
    for (int i = 0; i < NC; i++) {
        const int k = CONTROLLED[i];
        double ramp = TUNING_SETPOINT_RAMP[i], reach = isinf(ramp) ? ENDLESS : ramp * seconds;
        if (!s->active) {
            s->ramped[i] = within(state[k], STATES_LOWER[k], STATES_UPPER[k]);
            s->setpoint[i] = s->ramped[i];
        }
        if (isnan(s->requested[i])) {
            s->requested[i] = s->setpoint[i];
        }
        s->ramped[i] = within(s->requested[i], s->ramped[i] - reach, s->ramped[i] + reach);
        s->setpoint[i] += share * (s->ramped[i] - s->setpoint[i]);
    }
    s->active = 1;
}

/* Request a set-point; returns 1 where it is rejected.
 * Python: control.setpoint.request */
static int request_setpoint(controller_state *s, const double *setpoint)
{
    for (int i = 0; i < NC; i++) {
        const int k = CONTROLLED[i];
        if (setpoint[i] < STATES_LOWER[k] || setpoint[i] > STATES_UPPER[k]) {
            return 1;
        }
    }
    for (int i = 0; i < NC; i++) {
        if (!isnan(setpoint[i])) {
            s->requested[i] = setpoint[i];
        }
    }
    return 0;
}

/* Take inputs (NU) for those that act already.
 * Python: control.controller.Controller.initialise */
static void start_from(controller_state *s, const double *applied)
{
    copy(NU, applied, s->command);
    limit_command(s->command, NULL, 0.0);
    s->commanded = 1;
    enqueue(s, NEVER, applied);
}

void controller_safe_input(double *command)
{
    copy(NU, SAFE, command);
}

void controller_init(controller_state *s, const double *applied)
{
    memset(s, 0, sizeof *s);
    s->measured_at = NEVER;
    s->commanded_at = NEVER;
    s->accepted_at = NEVER;
#if ND
    for (int i = 0; i < ND; i++) {
        s->disturbed_at[i] = NEVER;
    }
    copy(ND, DISTURBANCES_CENTER, s->disturbance);
#endif
    s->law = -1;
    s->interval = ENDLESS;
    s->supervisor.level = -1;
    s->supervisor.resumes = -1;
    s->supervisor.status = CONTROLLER_NO_MEASUREMENT;
    s->supervisor.cause = CONTROLLER_NO_MEASUREMENT;
    s->supervisor.bad_since = NEVER;
    s->supervisor.better_since = NEVER;
    set_all(NC, (double)NAN, s->requested);
    if (applied && all_finite(NU, applied)) {
        start_from(s, applied);
    }
}

/* Answer a call with a new measurement, or without one.
 * Python: control.step.ControlStep.step */
static void answer(controller_state *s, const controller_inputs *inputs)
{
    const int received = inputs->received;
    const double usual = isinf(s->interval) ? 0.0 : s->interval, elapsed = since(s->commanded_at);
    const double interval = received ? smaller(usual, elapsed) : usual;
    double outside = (double)NAN, counted = 0.0;
    int fault;
    if (!received) {
        counted = smaller(elapsed, larger(1.0, 2.0 * usual));
    } else if (s->measured_at != NEVER && elapsed > 0.0) {
        /* neither a gap nor a burst is the spacing of the samples */
        double gap = smaller(since(s->measured_at), 2.0 * s->interval);
        s->interval = larger(gap, 0.5 * usual);
        counted = smaller(gap, elapsed);
    }
    const controller_state before = *s;
    if (received) {
        double state[NX];
        if (s->commanded) {
            follow_applied(s, inputs->applied);
        }
#if ND
        accept_disturbances(s, inputs->disturbance);
#endif
        fault = observe(s, inputs->measured, elapsed, &outside, state);
        if (fault == CONTROLLER_OK) {
            advance_setpoint(s, state, counted);
        }
    } else {
        fault = CONTROLLER_NO_MEASUREMENT;
        predict_to_now(s, elapsed, &s->estimate);
    }
    find_command(s, fault, outside, elapsed, interval, counted);
    if (!all_finite(NU, s->command) || (s->estimate.known && !usable(&s->estimate))) {
        *s = before;
        if (received) {
            s->measured_at = 0;
        }
        s->law = -1;
        s->transferring = 0;
        s->recovering = 0;
        s->estimate.known = 0;
        set_all(NXU, 0.0, s->target);
        find_command(s, CONTROLLER_CALCULATION_FAILED, (double)NAN, elapsed, interval, counted);
    }
}

void controller_step(controller_state *s, const controller_inputs *inputs,
                     controller_outputs *outputs)
{
    advance_clock(s, inputs->elapsed_ns);
    outputs->setpoint_rejected = request_setpoint(s, inputs->setpoint);
    if (!s->commanded && !inputs->received) {
        start_from(s, SAFE);            /* which is the answer from now on */
    }
    if (!inputs->received || !s->commanded || s->measured_at != 0) {
        answer(s, inputs);
    }
    outputs->level = s->supervisor.level;
    outputs->status = s->supervisor.status;
    outputs->cause = s->supervisor.cause;
    copy(NU, s->command, outputs->command);
    to_physical(OF_X, s->estimate.x, outputs->state);
    for (int i = 0; !s->estimate.known && i < NX; i++) {
        outputs->state[i] = (double)NAN;
    }
    for (int i = 0; i < NC; i++) {
        outputs->setpoint[i] = s->active ? s->setpoint[i] : (double)NAN;
    }
}
