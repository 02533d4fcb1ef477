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
#define NEVER INT64_MIN
#define SECOND 1e9
#define NO_REASON ((koopman_reason){KOOPMAN_OK, KOOPMAN_OK})

/* Matrices are arrays by rows. */

static double larger(double a, double b) { return isnan(a) || a > b ? a : b; }

static double smaller(double a, double b) { return isnan(a) || a < b ? a : b; }

static void copy(int n, const double *from, double *to)
{
    for (int i = 0; i < n; i++) to[i] = from[i];
}

static void fill(int n, double value, double *to)
{
    for (int i = 0; i < n; i++) to[i] = value;
}

static int finite(int n, const double *x)
{
    for (int i = 0; i < n; i++) if (!isfinite(x[i])) return 0;
    return 1;
}

static double size_of(int n, const double *x)
{
    double sum = 0.0;
    for (int i = 0; i < n; i++) sum += x[i] * x[i];
    return sqrt(sum);
}

/* y = y + factor x */
static void add(int n, double factor, const double *x, double *y)
{
    for (int i = 0; i < n; i++) y[i] += factor * x[i];
}

static void transpose(int m, int n, const double *A, double *At)
{
    for (int i = 0; i < m; i++) for (int j = 0; j < n; j++) At[j * m + i] = A[i * n + j];
}

/* C (m, n) = A (m, k) B (k, n) */
static void mul(int m, int k, int n, const double *A, const double *B, double *C)
{
    for (int i = 0; i < m; i++) {
        fill(n, 0.0, C + i * n);
        for (int l = 0; l < k; l++) add(n, A[i * k + l], B + l * n, C + i * n);
    }
}

/* C (m, n) = A' B of A (k, m) and B (k, n) */
static void mul_transposed(int m, int k, int n, const double *A, const double *B, double *C)
{
    fill(m * n, 0.0, C);
    for (int l = 0; l < k; l++)
        for (int i = 0; i < m; i++) add(n, A[l * m + i], B + l * n, C + i * n);
}

static void symmetric(int n, double *A)
{
    for (int i = 0; i < n; i++)
        for (int j = 0; j < i; j++)
            A[i * n + j] = A[j * n + i] = 0.5 * (A[i * n + j] + A[j * n + i]);
}

/* B (n, m) = A^-1 B by elimination with pivots; A is used up. */
static void solve(int n, int m, double *A, double *B)
{
    for (int k = 0; k < n; k++) {
        int pivot = k;
        for (int i = k + 1; i < n; i++)
            if (fabs(A[i * n + k]) > fabs(A[pivot * n + k])) pivot = i;
        for (int j = 0; j < n; j++) {
            double kept = A[k * n + j];
            A[k * n + j] = A[pivot * n + j], A[pivot * n + j] = kept;
        }
        for (int j = 0; j < m; j++) {
            double kept = B[k * m + j];
            B[k * m + j] = B[pivot * m + j], B[pivot * m + j] = kept;
        }
        for (int i = k + 1; i < n; i++) {
            double factor = A[i * n + k] / A[k * n + k];
            add(n - k, -factor, A + k * n + k, A + i * n + k);
            add(m, -factor, B + k * m, B + i * m);
        }
    }
    for (int k = n - 1; k >= 0; k--) {
        for (int i = k + 1; i < n; i++) add(m, -A[k * n + i], B + i * m, B + k * m);
        for (int j = 0; j < m; j++) B[k * m + j] /= A[k * n + k];
    }
}

/* X (n, m) = pseudo-inverse of A (m, n), by one-sided Jacobi rotations; returns the norm of A. */
static double pseudo_inverse(int m, int n, const double *A, double *X)
{
    int rows = m > n ? m : n, columns = m > n ? n : m;
    double U[MOST * MOST], V[MOST * MOST], largest = 0.0;
    if (m >= n) transpose(m, n, A, U); else copy(m * n, A, U);
    fill(columns * columns, 0.0, V);
    for (int i = 0; i < columns; i++) V[i * columns + i] = 1.0;
    for (int sweep = 0, turned = 1; turned && sweep < 30; sweep++) {
        turned = 0;
        for (int p = 0; p < columns; p++) for (int q = p + 1; q < columns; q++) {
            double *a = U + p * rows, *b = U + q * rows, aa = 0.0, bb = 0.0, ab = 0.0;
            for (int i = 0; i < rows; i++) aa += a[i] * a[i], bb += b[i] * b[i], ab += a[i] * b[i];
            if (!(fabs(ab) > 1e-16 * sqrt(aa * bb))) continue;
            turned = 1;
            double zeta = (bb - aa) / (2.0 * ab);
            double t = copysign(1.0, zeta) / (fabs(zeta) + sqrt(1.0 + zeta * zeta));
            double c = 1.0 / sqrt(1.0 + t * t), s = c * t;
            for (int i = 0; i < rows; i++) {
                double kept = a[i];
                a[i] = c * kept - s * b[i], b[i] = s * kept + c * b[i];
            }
            for (int i = 0; i < columns; i++) {
                double *v = V + p * columns + i, *w = V + q * columns + i, kept = *v;
                *v = c * kept - s * *w, *w = s * kept + c * *w;
            }
        }
    }
    for (int k = 0; k < columns; k++) largest = larger(largest, size_of(rows, U + k * rows));
    fill(m * n, 0.0, X);
    for (int k = 0; k < columns; k++) {
        double size = size_of(rows, U + k * rows);
        if (size <= 1e-15 * largest) continue;
        for (int i = 0; i < n; i++) for (int j = 0; j < m; j++)
            X[i * m + j] += (m >= n ? V[k * columns + i] * U[k * rows + j]
                             : U[k * rows + i] * V[k * columns + j]) / (size * size);
    }
    return largest;
}

/* --- The model, in scaled deviations from the nominal point ------------------------------- */

static void x_deviation(const double *value, double *x)
{
    for (int i = 0; i < NX; i++) x[i] = (value[i] - X_CENTER[i]) / X_SCALE[i];
}

static void x_physical(const double *x, double *value)
{
    for (int i = 0; i < NX; i++) value[i] = X_CENTER[i] + x[i] * X_SCALE[i];
}

static void u_deviation(const double *value, double *u)
{
    for (int i = 0; i < NU; i++) u[i] = (value[i] - U_CENTER[i]) / U_SCALE[i];
}

static void u_physical(const double *u, double *value)
{
    for (int i = 0; i < NU; i++) value[i] = U_CENTER[i] + u[i] * U_SCALE[i];
}

static void within(const double *u, double *limited)
{
    for (int i = 0; i < NU; i++) limited[i] = smaller(larger(u[i], U_LOWER[i]), U_UPPER[i]);
}

static double apart(const double *a, const double *b)
{
    double distance = 0.0;
    for (int i = 0; i < NX; i++) distance = larger(distance, fabs((a[i] - b[i]) / HALF_WIDTH[i]));
    return distance;
}

/* Distance of a state, in its units, from the training data in half-ranges. */
static double distance(const double *state)
{
    double x[NX], outside = 0.0, nearest = INFINITY;
    x_deviation(state, x);
    if (!finite(NX, x)) return INFINITY;
    for (int i = 0; i < NX; i++)
        outside = larger(outside, larger(CORNERS[i] - x[i], x[i] - CORNERS[NX + i]) / HALF_WIDTH[i]);
    for (int k = 0; k < N_TRAINING; k++) nearest = smaller(nearest, apart(TRAINING + k * NX, x));
    return N_TRAINING ? larger(outside, nearest - FILL_DISTANCE) : outside;
}

/* Product of the powers of x, differentiated by x_i and x_j where these are not negative. */
static double monomial(const int *powers, const double *x, int i, int j)
{
    double value = 1.0;
    for (int k = 0; k < NX; k++) {
        int power = powers[k];
        if (k == i) value *= power--;
        if (k == j) value *= power--;
        while (power-- > 0) value *= x[k];
    }
    return value;
}

/* psi = (x, phi(x)), its derivatives (N_PSI, NX) and second ones of phi (N_PHI, NX, NX) or NULL */
static void features(const double *x, double *psi, double *slope, double *bend)
{
    copy(NX, x, psi);
    fill(NX * NX, 0.0, slope);
    for (int i = 0; i < NX; i++) slope[i * NX + i] = 1.0;
    for (int k = 0; k < N_PHI; k++) {
        double *first = slope + (NX + k) * NX, *second = bend ? bend + k * NX * NX : NULL;
        if (!NETWORK) {
            psi[NX + k] = monomial(POWERS + k * NX, x, -1, -1);
            for (int i = 0; i < NX; i++) {
                first[i] = monomial(POWERS + k * NX, x, i, -1);
                for (int j = 0; bend && j < NX; j++)
                    second[i * NX + j] = monomial(POWERS + k * NX, x, i, j);
            }
            continue;
        }
        double a = BIAS[k];
        for (int i = 0; i < NX; i++) a += WEIGHT[k * NX + i] * x[i];
        double h = tanh(a), s = 1.0 - h * h;
        psi[NX + k] = h - AT_ZERO[k];
        for (int i = 0; i < NX; i++) {
            first[i] = s * WEIGHT[k * NX + i];
            for (int j = 0; bend && j < NX; j++)
                second[i * NX + j] = -2.0 * h * first[i] * WEIGHT[k * NX + j];
        }
    }
}

/* Secants of psi (N_PSI, NX), and of psi' w where H is not NULL, between two states. */
static void secants(const double *x, const double *x_ref, const double *w, double *M, double *H)
{
    double psi[N_PSI], slope[N_PSI * NX], psi_ref[N_PSI], bend[N_PHI_ * NX * NX], between[NX];
    features(x, psi, slope, NULL);
    features(x_ref, psi_ref, M, NULL);
    if (H) fill(N_PSI * NX, 0.0, H);
    if (NETWORK) {
        for (int k = 0; k < N_PHI; k++) {
            double h = psi[NX + k] + AT_ZERO[k], h_ref = psi_ref[NX + k] + AT_ZERO[k], a = 0.0;
            double b = BIAS[k], b_ref = BIAS[k], along = 0.0;
            for (int i = 0; i < NX; i++) {
                b += WEIGHT[k * NX + i] * x[i], b_ref += WEIGHT[k * NX + i] * x_ref[i];
                along += H ? WEIGHT[k * NX + i] * w[i] : 0.0;
            }
            a = b - b_ref;
            a += copysign(1e-300, a);
            double secant = tanh(a) / a * (1.0 - h * h_ref);
            for (int i = 0; i < NX; i++) {
                M[(NX + k) * NX + i] = secant * WEIGHT[k * NX + i];
                if (H) H[(NX + k) * NX + i] = -(h + h_ref) * along * M[(NX + k) * NX + i];
            }
        }
        return;
    }
    fill(N_PHI * NX, 0.0, M + NX * NX);
    for (int node = 0; node < 5; node++) {
        for (int i = 0; i < NX; i++) between[i] = x_ref[i] + NODES[node] * (x[i] - x_ref[i]);
        features(between, psi, slope, bend);
        add(N_PHI * NX, SHARES[node], slope + NX * NX, M + NX * NX);
        for (int k = 0; H && k < N_PHI * NX; k++) for (int j = 0; j < NX; j++)
            H[NX * NX + k] += SHARES[node] * bend[k * NX + j] * w[j];
    }
}

static void lift(const double *x, double *z)
{
    double psi[N_PSI], slope[N_PSI * NX];
    features(x, psi, slope, NULL);
    mul(NZ, N_PSI, 1, LIFT, psi, z);
}

/* The drift f (NX) and its derivative J (NX, NX), of the model or of its linearisation. */
static void drift(int linear, const double *x, double *f, double *J)
{
    double psi[N_PSI], slope[N_PSI * NX], bend[N_PHI_ * NX * NX];
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
    double z[NZ], N[NZ * NX], onto[NX * NZ], rate[NZ], AN[NZ * NX], rest[NZ], by_bend[NZ * NX];
    double bent[NX * NX], plain[N_PHI_], square[NX * NX], added[NX * NX];
    mul(NZ, N_PSI, 1, LIFT, psi, z);
    mul(NZ, N_PSI, NX, LIFT, slope, N);
    pseudo_inverse(NZ, NX, N, onto);
    mul(NZ, NZ, 1, A, z, rate);
    mul(NX, NZ, 1, onto, rate, f);
    mul(NZ, NZ, NX, A, N, AN);
    mul(NZ, NX, 1, N, f, rest);
    for (int i = 0; i < NZ; i++) rest[i] = rate[i] - rest[i];
    fill(NX * NX, 0.0, bent);
    for (int k = 0; k < N_PHI; k++) {
        plain[k] = 0.0;
        for (int i = 0; i < NZ; i++) plain[k] += LIFT[i * N_PSI + NX + k] * rest[i];
        add(NX * NX, plain[k], bend + k * NX * NX, bent);
        mul(NX, NX, 1, bend + k * NX * NX, f, slope + (NX + k) * NX);
    }
    fill(NX * NX, 0.0, slope);
    mul(NZ, N_PSI, NX, LIFT, slope, by_bend);
    add(NZ * NX, -1.0, by_bend, AN);
    for (int i = 0; i < NX; i++) for (int j = 0; j < NX; j++) {
        square[i * NX + j] = 0.0;
        for (int k = 0; k < NZ; k++) square[i * NX + j] += onto[i * NZ + k] * onto[j * NZ + k];
    }
    mul(NX, NZ, NX, onto, AN, J);
    mul(NX, NX, NX, square, bent, added);
    add(NX * NX, 1.0, added, J);
    mul(NX, NX, 1, PRE_FEEDBACK, x, rest);
    add(NX, -1.0, rest, f);
    add(NX * NX, -1.0, PRE_FEEDBACK, J);
}

/* B(x) (NX, NU); where J is not NULL, also the derivative (NX, NX) of B(x) u. */
static void input_matrix(int linear, const double *x, const double *u, double *B, double *J)
{
    copy(NX * NU, INPUT_MATRIX, B);
    if (J) fill(NX * NX, 0.0, J);
    for (int k = 0; !linear && k < N_TERMS; k++) {
        const double *term = TERMS + k * NX * NU;
        add(NX * NU, monomial(TERM_POWERS + k * NX, x, -1, -1), term, B);
        for (int i = 0; J && i < NX; i++) for (int j = 0; j < NU; j++) for (int l = 0; l < NX; l++)
            J[i * NX + l] += term[i * NU + j] * u[j] * monomial(TERM_POWERS + k * NX, x, l, -1);
    }
}

/* rate = f(x) + B(x) u + w, and where J is not NULL its derivative (NX, NX) */
static void rate_under(int linear, const double *x, const double *u, const double *w, double *rate,
                       double *J)
{
    double slope[NX * NX], B[NX * NU], by_input[NX], bend[NX * NX];
    drift(linear, x, rate, slope);
    input_matrix(linear, x, u, B, J ? bend : NULL);
    mul(NX, NU, 1, B, u, by_input);
    for (int i = 0; i < NX; i++) rate[i] += by_input[i] + (w ? w[i] : 0.0);
    for (int i = 0; J && i < NX * NX; i++) J[i] = slope[i] + bend[i];
}

/* D (NX, NX) with (B(x) - B(x_ref)) u = D (x - x_ref) */
static void input_secant(const double *x, const double *x_ref, const double *u, double *D)
{
    double between[NX], B[NX * NU], J[NX * NX];
    fill(NX * NX, 0.0, D);
    for (int node = 0; N_TERMS && node < 5; node++) {
        for (int i = 0; i < NX; i++) between[i] = x_ref[i] + NODES[node] * (x[i] - x_ref[i]);
        input_matrix(0, between, u, B, J);
        add(NX * NX, SHARES[node], J, D);
    }
}

/* The mean (NX, NX) of the drift's derivative from x_ref to x, plus D */
static void averaged_slope(const double *x, const double *x_ref, const double *D, double *slope)
{
    double M[N_PSI * NX], between[NX], f[NX], J[NX * NX];
    copy(NX * NX, D, slope);
    if (READ_OUT) {
        secants(x, x_ref, NULL, M, NULL);
        mul(NX, N_PSI, NX, DRIFT, M, J);
        add(NX * NX, 1.0, J, slope);
    }
    for (int node = 0; !READ_OUT && node < 5; node++) {
        for (int i = 0; i < NX; i++) between[i] = x_ref[i] + NODES[node] * (x[i] - x_ref[i]);
        drift(0, between, f, J);
        add(NX * NX, SHARES[node], J, slope);
    }
}

/* --- The sampled Riccati equation -------------------------------------------------------------- */

/* D of exp(F h) = I + D by its power series over a part of h, which is then doubled. Where S is
 * not NULL, y(0)' S y(0) is the integral of y' diag(W) y under y' = F y (Van Loan 1978). */
static void over_interval(int n, double h, const double *F, const double *W, double *D, double *S)
{
    double power[4 * NN * NN], next[4 * NN * NN], weighed[NN * NN];
    int doublings;
    frexp(size_of(n * n, F) * h * 1.4142135623730951, &doublings);
    doublings = doublings + 2 > 0 ? doublings + 2 : 0;
    h = ldexp(h, -doublings);
    fill(n * n, 0.0, D);
    fill(n * n, 0.0, power);
    for (int i = 0; i < n; i++) power[i * n + i] = 1.0;
    if (S) {
        fill(n * n, 0.0, S);
        fill(n * n, 0.0, weighed);
    }
    for (int k = 1; k < 15; k++) {
        if (S) {
            /* the block of Van Loan's matrix to the power of k above that of F */
            mul_transposed(n, n, n, F, weighed, next);
            for (int i = 0; i < n; i++) for (int j = 0; j < n; j++)
                weighed[i * n + j] = h / k * (W[i] * power[i * n + j] - next[i * n + j]);
            add(n * n, 1.0, weighed, S);
        }
        mul(n, n, n, power, F, next);
        for (int i = 0; i < n * n; i++) power[i] = h / k * next[i];
        add(n * n, 1.0, power, D);
    }
    if (S) {
        mul_transposed(n, n, n, D, S, next);
        add(n * n, 1.0, next, S);
        symmetric(n, S);
    }
    for (; doublings > 0; doublings--) {
        if (S) {
            mul_transposed(n, n, n, D, S, power);
            mul(n, n, n, power, D, next);
            for (int i = 0; i < n; i++) for (int j = 0; j < n; j++)
                next[i * n + j] += 2.0 * S[i * n + j] + power[i * n + j] + power[j * n + i];
            copy(n * n, next, S);
        }
        mul(n, n, n, D, D, next);
        add(n * n, 2.0, D, next);
        copy(n * n, next, D);
    }
}

/* P = H of the discrete equation P = A' P (I + G P)^-1 A + H with A = I + D, by doubling (E. K.-W.
 * Chu, H.-Y. Fan, W.-W. Lin, C.-S. Wang, Int. J. Control 77 (2004)); returns 0 where A does not
 * vanish. D, which keeps its digits where the interval is short, and G are used up. */
static int doubled(int n, double *D, double *G, double *H)
{
    double left[NR * NR], Y[NR * NR], GH[NR * NR], V[NR * NR], T[NR * NR];
    for (int step = 0; step < 40; step++) {
        mul(n, n, n, G, H, GH);
        for (int i = 0; i < n * n; i++) Y[i] = D[i] - GH[i];
        for (int i = 0; i < n; i++) GH[i * n + i] += 1.0;
        copy(n * n, GH, left);
        solve(n, n, left, Y);                       /* (I + G H)^-1 A = I + Y */
        copy(n * n, G, V);
        solve(n, n, GH, V);
        mul(n, n, n, H, Y, T);
        add(n * n, 1.0, H, T);
        mul_transposed(n, n, n, D, T, left);
        add(n * n, 1.0, T, left);
        add(n * n, 1.0, left, H);                   /* H + A' H (I + Y) */
        symmetric(n, H);
        mul(n, n, n, D, V, T);
        add(n * n, 1.0, V, T);
        for (int i = 0; i < n; i++) for (int j = 0; j < n; j++) {
            double sum = T[i * n + j];
            for (int k = 0; k < n; k++) sum += T[i * n + k] * D[j * n + k];
            G[i * n + j] += sum;                    /* G + A V A' */
        }
        symmetric(n, G);
        mul(n, n, n, D, Y, T);
        add(n * n, 1.0, Y, D);
        add(n * n, 1.0, T, D);                      /* A (I + Y) - I */
        copy(n * n, D, T);
        for (int i = 0; i < n; i++) T[i * n + i] += 1.0;
        if (size_of(n * n, T) < 1e-10) return finite(n * n, H);
    }
    return 0;
}

/* The gain K (NU, n) of the regulator of x' = A x + B u with held inputs, or a continuous one where
 * h is 0; the first states are weighted. */
static int riccati(int n, const double *A, const double *B, double h, double *K)
{
    double F[NN * NN], W[NN], D[NN * NN], S[NN * NN];
    double step[NR * NR], push[NR * NU], Q[NR * NR], R[NU * NU], cross[NU * NR], T[NR * NR];
    double G[NR * NR], P[NR * NR], by_push[NU * NR], by_cross[NU * NR], used[NU * NU], right[NU * NR];
    double PA[NR * NR], PB[NR * NU], left[NU * NU], terms, inverse[NR * NR], X[NR * NR], onto[NR * NU];
    if (!finite(n * n, A) || !finite(n * NU, B)) return KOOPMAN_NOT_STABILISABLE;
    int N = n + NU;
    fill(n * n, 0.0, Q);
    for (int i = 0; i < NX; i++) Q[i * n + i] = STATE_WEIGHT[i];
    fill(NU * NU, 0.0, R);
    for (int i = 0; i < NU; i++) R[i * NU + i] = INPUT_WEIGHT[i];
    fill(NU * n, 0.0, cross);
    copy(n * n, A, step);
    copy(n * NU, B, push);
    if (h > 0.0) {
        fill(N * N, 0.0, F);
        for (int i = 0; i < n; i++) {
            copy(n, A + i * n, F + i * N);
            copy(NU, B + i * NU, F + i * N + n);
            W[i] = i < NX ? STATE_WEIGHT[i] : 0.0;
        }
        copy(NU, INPUT_WEIGHT, W + n);
        over_interval(N, h, F, W, D, S);
        for (int i = 0; i < n; i++) {
            copy(n, D + i * N, step + i * n);
            copy(NU, D + i * N + n, push + i * NU);
            copy(n, S + i * N, Q + i * n);
        }
        for (int i = 0; i < NU; i++) {
            copy(n, S + (n + i) * N, cross + i * n);
            copy(NU, S + (n + i) * N + n, R + i * NU);
        }
    }
    /* without the cross term: step - push R^-1 cross, G = push R^-1 push', Q - cross' R^-1 cross */
    transpose(n, NU, push, by_push);
    copy(NU * NU, R, used);
    solve(NU, n, used, by_push);
    copy(NU * n, cross, by_cross);
    copy(NU * NU, R, used);
    solve(NU, n, used, by_cross);
    mul(n, NU, n, push, by_push, G);
    copy(n * n, Q, P);
    copy(n * n, step, D);
    mul(n, NU, n, push, by_cross, T);
    add(n * n, -1.0, T, D);
    mul_transposed(n, NU, n, cross, by_cross, T);
    add(n * n, -1.0, T, P);
    if (!(h > 0.0)) {
        /* a discrete equation with the same solution, by a Cayley transform beyond all modes */
        double far = size_of(n * n, A) + sqrt(size_of(n * n, G) * size_of(n * n, Q));
        fill(n * n, 0.0, inverse);
        for (int i = 0; i < n; i++) inverse[i * n + i] = 1.0, D[i * n + i] -= far;
        copy(n * n, D, T);
        solve(n, n, T, inverse);
        mul(n, n, n, inverse, G, X);
        mul(n, n, n, Q, X, T);
        for (int i = 0; i < n; i++) for (int j = 0; j < n; j++) T[i * n + j] += D[j * n + i];
        fill(n * n, 0.0, PA);
        for (int i = 0; i < n; i++) PA[i * n + i] = 2.0 * far;
        solve(n, n, T, PA);
        transpose(n, n, PA, D);
        mul(n, n, n, X, PA, G);
        mul(n, n, n, PA, Q, X);
        mul(n, n, n, X, inverse, P);
    }
    if (!doubled(n, D, G, P)) return KOOPMAN_NOT_STABILISABLE;
    mul(n, n, n, P, step, PA);
    mul(n, n, NU, P, push, PB);
    mul_transposed(NU, n, n, PB, step, right);      /* push' P step */
    if (!(h > 0.0)) fill(NU * n, 0.0, right);
    for (int i = 0; i < NU; i++) for (int j = 0; j < n; j++)
        right[i * n + j] += cross[i * n + j] + PB[j * NU + i];
    fill(NU * NU, 0.0, left);
    if (h > 0.0) mul_transposed(NU, n, NU, push, PB, left);
    add(NU * NU, 1.0, R, left);
    copy(NU * n, right, K);
    solve(NU, n, left, K);
    /* the equation less P on both sides, whose terms shrink with the interval */
    fill(n * n, 0.0, X);
    if (h > 0.0) mul_transposed(n, n, n, step, PA, X);
    mul_transposed(n, NU, n, right, K, T);
    terms = size_of(n * n, Q) + 2.0 * size_of(n * n, PA) + size_of(n * n, X) + size_of(n * n, T);
    for (int i = 0; i < n; i++) for (int j = 0; j < n; j++)
        X[i * n + j] += Q[i * n + j] - T[i * n + j] + PA[i * n + j] + PA[j * n + i];
    if (!(size_of(n * n, X) / terms <= MAX_RESIDUAL)) return KOOPMAN_RICCATI_INACCURATE;
    return pseudo_inverse(NU, n, K, onto) <= MAX_GAIN ? KOOPMAN_OK : KOOPMAN_GAIN_TOO_LARGE;
}

/* --- Control laws --------------------------------------------------------------------------- */

typedef struct {
    double x[NX], u[NU], forcing[NX];   /* forcing: B(x) u + w */
} target_t;

/* Whether e' = slope e + action e(last sample) decays, or without samples e' = (slope + action) e. */
static int decays(const double *slope, const double *action, double h)
{
    double held[4 * NX * NX], D[4 * NX * NX], step[NX * NX], next[NX * NX];
    int n = h > 0.0 ? 2 * NX : NX;
    fill(n * n, 0.0, held);
    for (int i = 0; i < NX; i++) for (int j = 0; j < NX; j++) {
        held[i * n + j] = slope[i * NX + j];
        held[i * n + (h > 0.0 ? NX : 0) + j] += action[i * NX + j];
    }
    if (!finite(n * n, held)) return 0;
    over_interval(n, h > 0.0 ? h : 1.0, held, NULL, D, NULL);
    for (int i = 0; i < NX; i++) for (int j = 0; j < NX; j++)
        step[i * NX + j] = D[i * n + j] + (h > 0.0 ? D[i * n + NX + j] : 0.0) + (i == j);
    /* a power of the matrix decides */
    for (int k = 0; k < 50; k++) {
        double size = size_of(NX * NX, step);
        if (size < 1.0) return 1;
        if (!(size < 1e100)) return 0;
        mul(NX, NX, NX, step, step, next);
        copy(NX * NX, next, step);
    }
    return 0;
}

/* u (NU) = u_ref - K e by the law of a model, in deviations; returns its status. */
static int law(int linear, const double *x, const target_t *target, double h, double *u)
{
    double B[NX * NU], K[NU * NR], e[NR], M[NR * NX], slope[NX * NX], D[NX * NX], action[NX * NX];
    double by_error[NU], KM[NU * NX];
    int status = KOOPMAN_NOT_STABILISABLE, n = NX;
    input_matrix(linear, x, NULL, B, NULL);
    input_secant(x, target->x, target->u, D);
    if (CLOSED && !linear) {
        /* re-centred: e = N(x) - N(x_ref), e' = (A + H C) e + N' B v */
        double psi[N_PSI], psi_slope[N_PSI * NX], psi_M[N_PSI * NX], psi_H[N_PSI * NX], z_ref[NZ];
        double N[NZ * NX], H[NZ * NX], loop[NZ * NZ], push[NZ * NU], more[NZ * NX], onto[NX * NZ];
        double forcing[NX];
        mul(NX, NX, 1, PRE_FEEDBACK, target->x, forcing);
        for (int i = 0; i < NX; i++) forcing[i] = target->forcing[i] - forcing[i];
        features(x, psi, psi_slope, NULL);
        secants(x, target->x, forcing, psi_M, psi_H);
        mul(NZ, N_PSI, 1, LIFT, psi, e);
        lift(target->x, z_ref);
        add(NZ, -1.0, z_ref, e);
        mul(NZ, N_PSI, NX, LIFT, psi_slope, N);
        mul(NZ, N_PSI, NX, LIFT, psi_M, M);
        mul(NZ, N_PSI, NX, LIFT, psi_H, H);
        copy(NX * NX, D, slope);
        add(NX * NX, -1.0, PRE_FEEDBACK, slope);
        mul(NZ, NX, NX, N, slope, more);
        add(NZ * NX, 1.0, more, H);
        copy(NZ * NZ, A, loop);
        for (int i = 0; i < NZ; i++) add(NX, 1.0, H + i * NX, loop + i * NZ);
        mul(NZ, NX, NU, N, B, push);
        n = NZ;
        status = riccati(NZ, loop, push, h, K);
        if (!READ_OUT) {
            mul(NZ, NZ, NX, A, M, more);
            add(NZ * NX, 1.0, H, more);
            pseudo_inverse(NZ, NX, N, onto);
            mul(NX, NZ, NX, onto, more, slope);
        }
    }
    if (linear) copy(NX * NX, SLOPE, slope);
    else if (READ_OUT || status != KOOPMAN_OK) averaged_slope(x, target->x, D, slope);
    if (status != KOOPMAN_OK) {
        n = NX;
        fill(NX * NX, 0.0, M);
        for (int i = 0; i < NX; i++) e[i] = x[i] - target->x[i], M[i * NX + i] = 1.0;
        status = riccati(NX, slope, B, h, K);
    }
    if (status != KOOPMAN_OK) return status;
    mul(NU, n, 1, K, e, by_error);
    for (int i = 0; i < NU; i++) u[i] = target->u[i] - by_error[i];
    mul(NU, n, NX, K, M, KM);
    mul(NX, NU, NX, B, KM, action);
    for (int i = 0; i < NX * NX; i++) action[i] = -action[i];
    return decays(slope, action, h) ? KOOPMAN_OK : KOOPMAN_PREDICTED_UNSTABLE;
}

/* --- Steady states ---------------------------------------------------------------------------- */

/* Solve f(x) + B(x) u + w = 0 for the free ones of y = (x, u) by Gauss-Newton steps, each to the
 * solution nearest to an anchor, in units of reach; returns 0 where there is none. */
static int equilibrium(int linear, const double *w, const int *free, const double *anchor,
                       const double *reach, double *y)
{
    double rate[NX], J[NX * NX], B[NX * NU], scaled[NX * NXU], onto[NXU * NX], wanted[NX];
    double step[NXU];
    int index[NXU], n = 0;
    for (int i = 0; i < NXU; i++) if (free[i]) index[n++] = i;
    if (!n) return 0;
    rate_under(linear, y, y + NX, w, rate, J);
    for (int count = 0; count < 30; count++) {
        double length = 0.0, slope = 0.0, share = 1.0;
        input_matrix(linear, y, NULL, B, NULL);
        for (int i = 0; i < NX; i++) {
            wanted[i] = -rate[i];
            for (int j = 0; j < n; j++) {
                int k = index[j];
                double by = k < NX ? J[i * NX + k] : B[i * NU + k - NX];
                wanted[i] += by * (y[k] - anchor[k]);
                scaled[i * n + j] = by * reach[k];
                slope += by * by;
            }
        }
        if (!isfinite(slope) || !finite(NX, rate)) return 0;
        pseudo_inverse(NX, n, scaled, onto);
        mul(n, NX, 1, onto, wanted, step);
        for (int j = 0; j < n; j++) {
            int k = index[j];
            step[j] = anchor[k] + reach[k] * step[j] - y[k];
            length = larger(length, fabs(step[j]));
        }
        if (length > 0.5) share = 0.5 / length;
        for (int j = 0; j < n; j++) y[index[j]] += share * step[j];
        rate_under(linear, y, y + NX, w, rate, J);
        if (size_of(NX, rate) <= 1e-9 * sqrt(slope) && (length <= 1e-6 || n <= NX)) return 1;
    }
    return 0;
}

/* Input (NXU: first NX) that is furthest outside its range, and by how much. */
static int furthest(const double *y, double *excess)
{
    int worst = 0;
    *excess = -INFINITY;
    for (int i = 0; i < NU; i++) {
        double beyond = larger(LOWER_V[i] - y[NX + i], y[NX + i] - UPPER_V[i]);
        if (beyond > *excess) *excess = beyond, worst = i;
    }
    return worst;
}

static double to_range(double v, int i) { return smaller(larger(v, LOWER_V[i]), UPPER_V[i]); }

/* y: the steady state with some states at a set-point, begun from y; returns 0 for none. */
static int partial_target(int linear, const double *goal, const double *w, double *y)
{
    double anchor[NXU], reach[NXU], found[NXU], excess;
    int free[NXU], spare = NU - NC;
    for (int i = 0; i < NXU; i++) anchor[i] = 0.0, reach[i] = 1.0, free[i] = 1;
    for (int i = 0; i < NC; i++) free[CONTROLLED[i]] = 0, y[CONTROLLED[i]] = goal[i];
    if (!equilibrium(linear, w, free, anchor, reach, y)) return 0;
    for (copy(NXU, y, found); spare > 0; spare--) {
        int worst = furthest(found, &excess);
        if (!(excess > 0.0)) break;
        /* the others are to make up for what this one lacks */
        free[NX + worst] = 0;
        found[NX + worst] = to_range(found[NX + worst], worst);
        if (!equilibrium(linear, w, free, anchor, reach, found)) return 1;
    }
    furthest(found, &excess);
    if (!(excess > 0.0)) copy(NXU, found, y);
    return 1;
}

/* y: the steady state nearest to a target y that inputs within their range hold, if there is. */
static void reachable_target(int linear, const double *w, double *y)
{
    double anchor[NXU], reach[NXU], found[NXU], excess;
    int free[NXU];
    copy(NXU, y, anchor);
    copy(NXU, y, found);
    for (int i = 0; i < NXU; i++) reach[i] = 1e3, free[i] = 1;
    for (int i = 0; i < NC; i++) reach[CONTROLLED[i]] = 1.0;
    for (int count = 0; count <= NU; count++) {
        int worst = furthest(found, &excess);
        if (!(excess > 1e-6)) {
            copy(NXU, found, y);
            return;
        }
        found[NX + worst] = to_range(found[NX + worst], worst);
        free[NX + worst] = 0;
        if (!equilibrium(linear, w, free, anchor, reach, found)) return;
        for (int i = 0; i < NX; i++)
            /* further off it is on another branch */
            if (!(fabs(found[i] - anchor[i]) <= 2.0 * HALF_WIDTH[i])) return;
    }
}

/* The steady state of a set-point (NC), in state units, under a disturbance; 0 for none. */
static int find_target(int linear, const double *setpoint, const double *w, const double *start,
                       target_t *target)
{
    double goal[NC], y[NXU], f[NX], B[NX * NU], J[NX * NX], inverse[NU * NX], added[NX];
    for (int i = 0; i < NC; i++) {
        int k = CONTROLLED[i];
        goal[i] = (setpoint[i] - X_CENTER[k]) / X_SCALE[k];
    }
    if (CONTROLS_ALL) {
        copy(NX, goal, y);
        drift(linear, y, f, J);
        add(NX, 1.0, w, f);
        input_matrix(linear, y, NULL, B, NULL);
        pseudo_inverse(NX, NU, B, inverse);
        mul(NU, NX, 1, inverse, f, y + NX);
        for (int i = 0; i < NU; i++) y[NX + i] = -y[NX + i];
    } else {
        fill(NXU, 0.0, y);
        if (start) {
            x_deviation(start, y);
            u_deviation(start + NX, y + NX);
        }
        if (!partial_target(linear, goal, w, y)) return 0;
    }
    if (NU > 1 && NC <= NU) {
        double u[NU], limited[NU];
        int inside = 1;
        u_physical(y + NX, u);
        within(u, limited);
        for (int i = 0; i < NU; i++) inside = inside && limited[i] == u[i];
        if (!inside) reachable_target(linear, w, y);
    }
    copy(NX, y, target->x);
    copy(NU, y + NX, target->u);
    input_matrix(linear, y, NULL, B, NULL);
    mul(NX, NU, 1, B, y + NX, added);
    for (int i = 0; i < NX; i++) target->forcing[i] = added[i] + w[i];
    return 1;
}

/* --- Estimation --------------------------------------------------------------------------------- */

/* w (NX) within max_disturbance; none where it is not finite. */
static void bounded(double *w)
{
    double v[NU], share = 0.0;
    mul(NU, NX, 1, INPUT_INVERSE, w, v);
    for (int i = 0; i < NU; i++) share = larger(share, fabs(v[i]) / MAX_DISTURBANCE[i]);
    for (int i = 0; i < NX && !(share <= 1.0); i++) w[i] = isfinite(share) ? w[i] / share : 0.0;
}

/* The rates of x and, in the columns behind it, of its derivatives by what x and w were. */
static void variations(int linear, const double *u, const double *w, const double *whole,
                       double *rate)
{
    double x[NX], f[NX], J[NX * NX];
    for (int i = 0; i < NX; i++) x[i] = whole[i * (1 + NP)];
    rate_under(linear, x, u, w, f, J);
    mul(NX, NX, 1 + NP, J, whole, rate);
    for (int i = 0; i < NX; i++) rate[i * (1 + NP)] = f[i], rate[i * (1 + NP) + 1 + NX + i] += 1.0;
}

/* Predict an estimate under an input (NU), in its units, for some seconds; 0 where it is lost. */
static int predict_held(int linear, koopman_estimate *estimate, const double *input, double seconds)
{
    double u[NU], duration = seconds / TIME_UNIT, half = 0.5;
    double count = ceil(seconds * (KALMAN ? FASTEST_MODE / 0.5 : FASTEST_RATE / 0.1)), h;
    count = larger(1.0, count);
    if (!(count <= (KALMAN ? 40.0 : 20.0))) return 0;
    h = duration / count;
    u_deviation(input, u);
    if (!KALMAN) {
        double *x = estimate->x, first[NX], second[NX], ahead[NX];
        for (int k = 0; k < count; k++) {
            rate_under(linear, x, u, estimate->w, first, NULL);
            for (int i = 0; i < NX; i++) ahead[i] = x[i] + h * first[i];
            rate_under(linear, ahead, u, estimate->w, second, NULL);
            for (int i = 0; i < NX; i++) x[i] += half * h * (first[i] + second[i]);
        }
        for (int i = 0; i < NX; i++) if (!(fabs(x[i]) <= 10.0 * HALF_WIDTH[i])) return 0;
        return 1;
    }
    double whole[NX * (1 + NP)], k1[NX * (1 + NP)], k2[NX * (1 + NP)], k3[NX * (1 + NP)];
    double k4[NX * (1 + NP)], at[NX * (1 + NP)], *P = estimate->P, F[NP * NP], FP[NP * NP];
    if (!estimate->certain) copy(NP * NP, FIRST_COVARIANCE, P);
    for (int i = 0; i < NX; i++) for (int j = 0; j < NX; j++)
        P[(NX + i) * NP + NX + j] += seconds * INTENSITY[i * NX + j];
    fill(NX * (1 + NP), 0.0, whole);
    for (int i = 0; i < NX; i++)
        whole[i * (1 + NP)] = estimate->x[i], whole[i * (1 + NP) + 1 + i] = 1.0;
    for (int k = 0; k < count; k++) {
        variations(linear, u, estimate->w, whole, k1);
        for (int i = 0; i < NX * (1 + NP); i++) at[i] = whole[i] + half * h * k1[i];
        variations(linear, u, estimate->w, at, k2);
        for (int i = 0; i < NX * (1 + NP); i++) at[i] = whole[i] + half * h * k2[i];
        variations(linear, u, estimate->w, at, k3);
        for (int i = 0; i < NX * (1 + NP); i++) at[i] = whole[i] + h * k3[i];
        variations(linear, u, estimate->w, at, k4);
        for (int i = 0; i < NX * (1 + NP); i++)
            whole[i] += h / 6.0 * (k1[i] + 2.0 * k2[i] + 2.0 * k3[i] + k4[i]);
    }
    fill(NP * NP, 0.0, F);
    for (int i = 0; i < NX; i++) {
        estimate->x[i] = whole[i * (1 + NP)];
        copy(NP, whole + i * (1 + NP) + 1, F + i * NP);
        F[(NX + i) * NP + NX + i] = 1.0;
    }
    mul(NP, NP, NP, F, P, FP);
    transpose(NP, NP, F, P);
    copy(NP * NP, P, F);
    mul(NP, NP, NP, FP, F, P);
    for (int i = 0; i < NX; i++) if (!(P[i * NP + i] <= LOST_VARIANCE[i])) return 0;
    symmetric(NP, P);
    estimate->certain = 1;
    return 1;
}

static int usable(const koopman_estimate *estimate)
{
    return finite(NX, estimate->x) && finite(NX, estimate->w) && (
        !estimate->certain || finite(NP * NP, estimate->P));
}

/* Take the outputs of a state (NX) into account, so many seconds after the last ones. */
static void correct(koopman_estimate *estimate, const double *x, double seconds)
{
    double innovation[NY], difference[NX], *P = estimate->P;
    for (int i = 0; i < NX; i++) difference[i] = x[i] - estimate->x[i];
    if (!KALMAN) {
        double p = exp(-BANDWIDTH * seconds), duration = seconds / TIME_UNIT;
        if (!REMEMBERS) {
            copy(NX, x, estimate->x);
            fill(NX, 0.0, estimate->w);
            return;
        }
        add(NX, (1.0 - p) * (1.0 - p) / duration, difference, estimate->w);
        add(NX, 1.0 - p * p, difference, estimate->x);
        bounded(estimate->w);
        return;
    }
    double HP[NY * NP], S[NY * NY], gain[NP * NY], by_gain[NY * NP], keep[NP * NP], half[NP * NP];
    double step[NP];
    if (!estimate->certain) copy(NP * NP, FIRST_COVARIANCE, P);
    mul(NY, NX, 1, H_OUTPUT, difference, innovation);
    mul(NY, NX, NP, H_OUTPUT, P, HP);               /* P is symmetric */
    for (int i = 0; i < NY; i++) for (int j = 0; j < NY; j++) {
        S[i * NY + j] = i == j ? NOISE_VARIANCE[i] : 0.0;
        for (int k = 0; k < NX; k++) S[i * NY + j] += HP[i * NP + k] * H_OUTPUT[j * NX + k];
    }
    copy(NY * NP, HP, by_gain);
    solve(NY, NP, S, by_gain);
    transpose(NY, NP, by_gain, gain);
    fill(NP * NP, 0.0, keep);
    for (int i = 0; i < NP; i++) {
        keep[i * NP + i] = 1.0;
        for (int k = 0; k < NY; k++) add(NX, -gain[i * NY + k], H_OUTPUT + k * NX, keep + i * NP);
    }
    mul(NP, NP, NP, keep, P, half);
    transpose(NP, NP, keep, P);
    copy(NP * NP, P, keep);
    mul(NP, NP, NP, half, keep, P);
    for (int k = 0; k < NY; k++) for (int i = 0; i < NP; i++)
        add(NP, gain[i * NY + k] * NOISE_VARIANCE[k], by_gain + k * NP, P + i * NP);
    symmetric(NP, P);
    estimate->certain = 1;
    mul(NP, NY, 1, gain, innovation, step);
    add(NX, 1.0, step, estimate->x);
    add(NX, 1.0, step + NX, estimate->w);
    bounded(estimate->w);
}

/* Start from a measured state (NX): with the disturbance as known, or where u (NU) is not NULL the
 * one under which u holds the plant. */
static void restart(int linear, koopman_estimate *estimate, const double *x, const double *u)
{
    double rate[NX];
    if (u) {
        rate_under(linear, x, u, NULL, rate, NULL);
        for (int i = 0; i < NX; i++) rate[i] = -rate[i];
        if (KALMAN) mul(NX, NX, 1, ONTO_DISTURBANCES, rate, estimate->w);
        else copy(NX, rate, estimate->w);
        bounded(estimate->w);
    } else if (!estimate->known) {
        fill(NX, 0.0, estimate->w);
    }
    if (!REMEMBERS) fill(NX, 0.0, estimate->w);
    copy(NX, x, estimate->x);
    estimate->certain = 0;
    if (KALMAN) correct(estimate, x, 0.0);
    estimate->known = 1;
}

/* The level in terms of whose model the estimate is. */
static int model_level(const koopman_supervisor *supervisor)
{
    int level = supervisor->resumes >= 0 ? supervisor->resumes : supervisor->level;
    return level < 0 ? 0 : level < LAWS ? level : LAWS - 1;
}

/* Transfer an estimate from the model of a level to that of another; the plant's rate stays. */
static void transfer(koopman_estimate *estimate, int before, int now)
{
    double f[NX], J[NX * NX];
    if (before == now || !REMEMBERS) return;
    drift(LINEAR[before], estimate->x, f, J);
    add(NX, 1.0, f, estimate->w);
    drift(LINEAR[now], estimate->x, f, J);
    add(NX, -1.0, f, estimate->w);
    if (KALMAN) {
        copy(NX, estimate->w, f);
        mul(NX, NX, 1, ONTO_DISTURBANCES, f, estimate->w);
    }
    bounded(estimate->w);
}

/* --- Time and inputs under way ----------------------------------------------------------------------------- */

/* Seconds since a time; 0 if it never was. */
static double since(const koopman_state *s, int64_t time)
{
    return time == NEVER ? 0.0 : (double)(s->now - time) / SECOND;
}

/* Index of the last input applied by a time, or of the first one. */
static int applied_by(const koopman_state *s, int64_t time)
{
    int k = s->queued - 1;
    while (k > 0 && s->applied_at[k] > time) k--;
    return k;
}

static void acting(const koopman_state *s, int64_t time, double *u)
{
    for (int i = 0; i < NU; i++) u[i] = s->applied[applied_by(s, time - DEAD_TIME[i])][i];
}

/* The end of the time from begin on, up to end, in which the input stays; u (NU) is that input. */
static int64_t piece(const koopman_state *s, int64_t begin, int64_t end, double *u)
{
    for (int k = 0; k < s->queued; k++) for (int i = 0; i < NU; i++) {
        int64_t edge = s->applied_at[k] + DEAD_TIME[i];
        if (edge > begin && edge < end) end = edge;
    }
    acting(s, begin, u);
    return end;
}

/* Append an input in place of those from its time on; drop those that no longer act. */
static void enqueue(koopman_state *s, int64_t time, const double *u)
{
    int begin = 0;
    while (s->queued > 0 && s->applied_at[s->queued - 1] >= time) s->queued--;
    if (!LONGEST_DEAD_TIME) begin = s->queued;
    else if (s->queued > 0) begin = applied_by(s, time - LONGEST_DEAD_TIME);
    if (s->queued - begin == KOOPMAN_QUEUE) begin++;
    s->queued -= begin;
    for (int k = 0; k < s->queued; k++) {
        s->applied_at[k] = s->applied_at[k + begin];
        copy(NU, s->applied[k + begin], s->applied[k]);
    }
    s->applied_at[s->queued] = time;
    copy(NU, u, s->applied[s->queued++]);
}

/* Predict an estimate up to a time, where there is one; as uncertain as at first where it is lost. */
static void predict(const koopman_state *s, int64_t time, double elapsed, koopman_estimate *estimate)
{
    koopman_estimate before = *estimate;
    int linear = LINEAR[model_level(&s->supervisor)];
    double u[NU];
    if (!estimate->known || !s->commanded || !(elapsed > 0.0)) return;
    for (int64_t begin = s->commanded_at, end; begin < time; begin = end) {
        end = piece(s, begin, time, u);
        if (!predict_held(linear, estimate, u, (double)(end - begin) / SECOND)
                || !usable(estimate)) {
            *estimate = before;
            estimate->certain = 0;
            return;
        }
    }
}

/* The state (NX) of a measurement; what that leaves open is as estimated, or as in a steady state. */
static void position(const koopman_estimate *estimate, const double *y, double *state)
{
    double rest[NY], guess[NX], added[NX], none[NX], anchor[NXU], reach[NXU], found[NXU];
    int free[NXU];
    mul(NX, NY, 1, FROM_OUTPUTS, y, state);
    if (DETERMINED) return;
    if (estimate->known) x_physical(estimate->x, guess);
    else copy(NX, X_CENTER, guess);
    mul(NY, NX, 1, OUTPUTS, guess, rest);
    for (int i = 0; i < NY; i++) rest[i] = y[i] - rest[i];
    mul(NX, NY, 1, FROM_OUTPUTS, rest, added);
    for (int i = 0; i < NX; i++) state[i] = guess[i] + added[i];
    if (estimate->known || !RESTS || !finite(NX, state)) return;
    for (int i = 0; i < NXU; i++) {
        anchor[i] = 0.0, reach[i] = 1.0;
        free[i] = i >= NX || !MEASURED[i];
    }
    fill(NX, 0.0, none);
    x_deviation(state, found);
    fill(NU, 0.0, found + NX);
    if (equilibrium(0, none, free, anchor, reach, found)) x_physical(found, state);
}

/* --- Sensor checks ---------------------------------------------------------------------------------- */

/* Check a measurement (NY) against the last accepted one, of `before`; renew that in s. */
static int check(const koopman_state *before, koopman_state *s, const double *y, double elapsed,
                 double outside, int *moved)
{
    const koopman_estimate *estimate = &before->estimate;
    double worst = 0.0, change[NY], travel[NY], step[NX];
    int jumped = before->jumped, still = 0, stuck = 0;
    *moved = 0;
    for (int i = 0; i < NY; i++) {
        if (!isfinite(y[i])) return KOOPMAN_NOT_FINITE;
        if (!(y[i] >= SENSOR_LOWER[i] && y[i] <= SENSOR_UPPER[i])) return KOOPMAN_OUTSIDE_SENSOR;
    }
    double seconds = since(s, before->accepted_at);
    for (int i = 0; i < NY && before->accepted_at != NEVER; i++) {
        change[i] = fabs(y[i] - before->accepted[i]);
        worst = larger(worst, change[i] / (MAX_STEP[i] + MAX_RATE[i] * seconds));
        *moved = *moved || (jumped && change[i] > MAX_STEP[i]);
        still = still || change[i] == 0.0;
    }
    if (worst > 1.0) {
        s->jumped = 1;
        return KOOPMAN_JUMPED;
    }
    copy(NY, y, s->accepted);
    s->accepted_at = s->now;
    s->jumped = 0;
    if (!still) {
        for (int i = 0; i < NX; i++) s->still_w[i] = estimate->known ? estimate->w[i] : 0.0;
        for (int i = 0; i < NY; i++) s->still_since[i] = s->now, s->travel[i] = 0.0;
        return KOOPMAN_OK;
    }
    /* what the model says of its motion far outside, or under the safe input, is worth little */
    fill(NY, 0.0, travel);
    if (!(outside > 0.0) && !before->recovering && estimate->known) {
        koopman_estimate moves = *estimate;
        copy(NX, before->still_w, moves.w);
        predict(before, s->now, elapsed, &moves);
        for (int i = 0; i < NX; i++) step[i] = (moves.x[i] - estimate->x[i]) * X_SCALE[i];
        mul(NY, NX, 1, OUTPUTS, step, travel);
    }
    for (int i = 0; i < NY; i++) {
        if (change[i] != 0.0) {
            s->still_since[i] = s->now, s->travel[i] = 0.0;
            continue;
        }
        s->travel[i] += travel[i];
        stuck = stuck || (fabs(s->travel[i]) > 0.5 * MAX_STEP[i] && STUCK_TIMEOUT > 0.0
                           && since(s, s->still_since[i]) > STUCK_TIMEOUT);
    }
    if (stuck) *moved = 0;
    return stuck ? KOOPMAN_FROZEN : KOOPMAN_OK;
}

/* Take into account that the last command was not followed, where the applied inputs are measured. */
static void follow(koopman_state *s, const double *applied)
{
    double *last = s->applied[s->queued > 0 ? s->queued - 1 : 0];
    if (!s->commanded) return;
    copy(NU, s->command, last);
    for (int i = 0; i < NU && finite(NU, applied); i++)
        last[i] = smaller(larger(last[i], applied[i] - TOLERANCE[i]), applied[i] + TOLERANCE[i]);
}

/* Check a measurement and take it into account: the state (NX) it stands for, in its units, and its
 * distance from the training data. */
static int observe(koopman_state *s, const double *y, double elapsed, double *outside, double *state)
{
    const koopman_state before = *s;
    koopman_estimate *estimate = &s->estimate;
    double x[NX], u[NU], held[NU], silent;
    int moved, fault, level = model_level(&s->supervisor);
    predict(s, s->now, elapsed, estimate);
    position(estimate, y, state);
    *outside = distance(state);
    fault = check(&before, s, y, elapsed, *outside, &moved);
    s->measured_at = s->now;
    if (fault == KOOPMAN_FROZEN && estimate->known)
        copy(NX, before.still_w, estimate->w);
    if (fault != KOOPMAN_OK) return fault;
    x_deviation(state, x);
    silent = since(s, before.accepted_at);
    if (!estimate->known) {
        if (s->commanded) {
            acting(s, s->now, held);
            u_deviation(held, u);
        }
        restart(LINEAR[level], estimate, x, s->commanded ? u : NULL);
    } else if (moved || !(elapsed > 0.0) || *outside > MARGIN[LAWS - 1]
               || (silent * BANDWIDTH > 2.0 && silent > 1.5 * s->interval)) {
        restart(LINEAR[level], estimate, x, NULL);
    } else {
        correct(estimate, x, elapsed);
    }
    if (!DETERMINED) {
        position(estimate, y, state);
        *outside = distance(state);
    }
    return KOOPMAN_OK;
}

/* --- The control step --------------------------------------------------------------------------------- */

typedef struct {
    int level, passing;
    koopman_reason reason;
} request_t;

/* Fall back at once, and recover when that was possible for long enough. */
static koopman_supervisor supervised(const koopman_supervisor *s, request_t to, int64_t now)
{
    int settled = s->resumes >= 0 ? s->resumes : s->level < 0 ? 0 : s->level;
    koopman_supervisor next = {to.level, -1, to.reason, NEVER, NEVER};
    if (to.level == KOOPMAN_HOLD) {
        next.bad_since = s->bad_since == NEVER ? now : s->bad_since;
        int too_long = (double)(now - next.bad_since) / SECOND > HOLD_TIMEOUT;
        if (too_long) next.reason.status = KOOPMAN_HELD_TOO_LONG;
        if (too_long || (s->level == KOOPMAN_SAFE && s->bad_since != NEVER)) {
            next.level = KOOPMAN_SAFE;
            to.passing = 0;
        }
    }
    if (to.passing && settled < next.level) {
        next.resumes = settled;
        return next;
    }
    if (to.passing && next.level == KOOPMAN_HOLD && settled > KOOPMAN_HOLD) {
        next.level = settled;
        return next;
    }
    if (next.level >= settled) return next;
    int64_t since = s->better_since == NEVER ? now : s->better_since;
    if ((double)(now - since) / SECOND >= RECOVERY_TIME) return next;
    next = (koopman_supervisor){settled, -1, s->reason, s->bad_since, since};
    if (next.reason.status != KOOPMAN_OK) next.reason.status = KOOPMAN_RECOVERING;
    return next;
}

/* The level that the distance from the training data allows; a margin is left at half of it. */
static request_t allowed(const koopman_supervisor *s, double outside)
{
    int settled = s->resumes >= 0 ? s->resumes : s->level < 0 ? 0 : s->level;
    for (int k = LAWS - 1; k >= 0; k--) {
        int below = k < LAWS - 1 ? k + 1 : KOOPMAN_SAFE;
        double margin = settled >= below ? 0.5 * MARGIN[k] : MARGIN[k];
        if (outside > 0.0 && outside > margin)
            return (request_t){below, 0, {KOOPMAN_OUTSIDE_TRAINING, KOOPMAN_OUTSIDE_TRAINING}};
    }
    return (request_t){0, 0, NO_REASON};
}

/* Bring a command within its range, and within its rate. */
static void limit(const double *wanted, const double *previous, double seconds, double *u)
{
    within(wanted, u);
    for (int i = 0; previous && i < NU; i++) {
        double reach = isinf(RATE_LIMIT[i]) ? INFINITY : RATE_LIMIT[i] * larger(0.0, seconds);
        u[i] = smaller(larger(u[i], previous[i] - reach), previous[i] + reach);
    }
}

/* Evaluate a law, in units within range; returns its status. */
static int evaluate(int linear, const double *x, const target_t *target, double interval, double *u)
{
    double v[NU], wanted[NU];
    int status = law(linear, x, target, interval / TIME_UNIT, v);
    if (status != KOOPMAN_OK) return status;
    u_physical(v, wanted);
    if (!finite(NU, wanted)) return KOOPMAN_COMMAND_NOT_FINITE;
    within(wanted, u);
    return KOOPMAN_OK;
}

/* Predict an estimate from one time to another, short pieces by their mean; 0 where it is lost.
 * Inputs with a dead time up to `acts` are held at `held`. */
static int ahead(const koopman_state *s, int linear, int64_t begin, int64_t end, int64_t acts,
                 const double *held, koopman_estimate *estimate)
{
    double step = FASTEST_RATE > 0.0 ? 0.1 / FASTEST_RATE : INFINITY, gathered = 0.0, u[NU], mean[NU];
    fill(NU, 0.0, mean);
    for (int64_t next; begin < end; begin = next) {
        next = piece(s, begin, end, u);
        double seconds = (double)(next - begin) / SECOND, count;
        for (int i = 0; i < NU; i++) mean[i] += seconds * (DEAD_TIME[i] <= acts ? held[i] : u[i]);
        gathered += seconds;
        if (gathered < step && next < end) continue;
        count = larger(1.0, ceil(gathered / (10.0 * step)));
        for (int i = 0; i < NU; i++) mean[i] /= gathered;
        for (int k = 0; k < count; k++)
            if (!predict_held(linear, estimate, mean, gathered / count) || !usable(estimate)) return 0;
        fill(NU, 0.0, mean);
        gathered = 0.0;
    }
    return 1;
}

/* Evaluate the law for each input at the state predicted for the time at which it acts; the faster
 * inputs follow the law until then. */
static int evaluate_ahead(const koopman_state *s, int linear, koopman_estimate *estimate,
                          const target_t *target, double interval, int64_t now, double *u)
{
    double held[NU], later[NU], limited[NU], count = 1.0;
    int status;
    if (!LONGEST_DEAD_TIME || !s->queued) return evaluate(linear, estimate->x, target, interval, u);
    if (!ahead(s, linear, now, now + SHORTEST_DEAD_TIME, -1, u, estimate)) return KOOPMAN_NOT_PREDICTED;
    status = evaluate(linear, estimate->x, target, interval, u);
    if (status != KOOPMAN_OK || SHORTEST_DEAD_TIME == LONGEST_DEAD_TIME) return status;
    copy(NU, u, held);
    if (interval > 0.0)
        count = smaller(20.0, ceil((double)(LONGEST_DEAD_TIME - SHORTEST_DEAD_TIME) / SECOND / interval));
    for (int64_t begin = SHORTEST_DEAD_TIME, end; begin < LONGEST_DEAD_TIME; begin = end) {
        end = LONGEST_DEAD_TIME;
        for (int k = 1; k < count; k++) {
            int64_t edge = (int64_t)rint(k * ((double)(LONGEST_DEAD_TIME - SHORTEST_DEAD_TIME) / count)
                                         + (double)SHORTEST_DEAD_TIME);
            if (edge > begin && edge < end) end = edge;
        }
        for (int i = 0; i < NU; i++) if (DEAD_TIME[i] > begin && DEAD_TIME[i] < end) end = DEAD_TIME[i];
        if (!ahead(s, linear, now + begin, now + end, begin, held, estimate)) return KOOPMAN_NOT_PREDICTED;
        double seconds = (double)(end - begin) / SECOND;
        status = evaluate(linear, estimate->x, target, seconds, later);
        if (status != KOOPMAN_OK) return status;
        for (int i = 0; i < NU; i++) if (DEAD_TIME[i] == end) u[i] = later[i];
        limit(later, held, seconds, limited);
        copy(NU, limited, held);
    }
    return KOOPMAN_OK;
}

/* Whether the law failed in the tested loop nearest to a state and a set-point (NX). */
static int failed_near(const double *x, const double *x_ref)
{
    double nearest[2] = {INFINITY, INFINITY};
    for (int k = 0; k < N_LOOPS; k++) {
        double away = larger(apart(LOOP_STARTS + k * NX, x), apart(LOOP_SETPOINTS + k * NX, x_ref));
        nearest[LOOP_LOST[k]] = smaller(nearest[LOOP_LOST[k]], away);
    }
    return nearest[1] < nearest[0];
}

/* Follow how far the plant has come back where the safe input keeps it outside. */
static void recover(koopman_state *s, int fault, double outside)
{
    double state[NX], x[NX], u[NU], u_safe[NU], B[NX * NU], rate[NX], toward = 0.0;
    int was = s->recovering;
    s->recovering = 0;
    if (s->supervisor.level != KOOPMAN_SAFE || fault != KOOPMAN_OK) return;
    position(&s->estimate, s->accepted, state);
    x_deviation(state, x);
    u_deviation(NOMINAL, u);
    u_deviation(SAFE, u_safe);
    add(NU, -1.0, u_safe, u);
    input_matrix(0, x, NULL, B, NULL);
    mul(NX, NU, 1, B, u, rate);
    for (int i = 0; i < NX; i++) toward += x[i] * rate[i];
    if (outside > 0.0 && !(toward < 0.0)) return;
    if (was) {
        double change = outside - s->farthest, still = 0.03 * (1.0 + s->farthest);
        if (!(outside > 0.0 || s->led)) return;
        s->recovering = 1;
        if (!(change > still || (change < -still && !s->led))) {
            s->led = s->led || since(s, s->resting_since) >= 3.0 * RECOVERY_TIME;
            s->nearest = smaller(s->nearest, outside);
            return;
        }
    } else if (!(outside > 0.0) || s->supervisor.bad_since != NEVER
               || s->supervisor.better_since != NEVER) {
        return;
    }
    s->recovering = 1;
    s->led = 0;
    s->farthest = s->nearest = outside;
    s->resting_since = s->now;
}

/* Let the offset of a bumpless transfer fade with d (1 + t/T) exp(-t/T). */
static void fade(koopman_state *s, double seconds)
{
    double share = TRANSFER_TIME > 0.0 ? seconds / TRANSFER_TIME : 0.0, offset = 0.0, feed = 0.0;
    for (int i = 0; i < NU; i++) {
        s->offset[i] = exp(-share) * (s->offset[i] + share * s->feed[i]);
        s->feed[i] *= exp(-share);
        offset = larger(offset, fabs(s->offset[i]));
        feed = larger(feed, fabs(s->feed[i]));
    }
    if (seconds > 100.0 * TRANSFER_TIME || !(offset + feed > 1e-9)) s->transferring = 0;
}

/* The input that a law, or none, gives; s is renewed but for the command itself. */
static void automatic(koopman_state *s, int fault, double outside, double elapsed, double interval,
                      double *wanted)
{
    const koopman_supervisor before = s->supervisor;
    request_t to = allowed(&before, outside);
    target_t target;
    double u[NU] = {0}, start[NXU];
    int targeted = 0, found = 0, from = model_level(&before);
    if (fault != KOOPMAN_OK) to = (request_t){KOOPMAN_HOLD, 1, {fault, fault}};
    copy(NXU, s->target, start);
    for (;;) {
        s->supervisor = supervised(&before, to, s->now);
        int level = s->supervisor.level;
        if (level >= LAWS) break;
        koopman_estimate estimate = s->estimate;
        int status = KOOPMAN_NO_STEADY_STATE;
        transfer(&estimate, from, level);
        targeted = find_target(LINEAR[level], s->setpoint, estimate.w, s->targeted ? start : NULL,
                               &target);
        if (targeted)
            status = evaluate_ahead(s, LINEAR[level], &estimate, &target, interval, s->now, u);
        if (status != KOOPMAN_OK) {
            to = (request_t){level + 1, 0, {KOOPMAN_LAW_FAILED, status}};
            continue;
        }
        found = 1;
        if (level + 1 == LAWS || LINEAR[level] || !failed_near(estimate.x, target.x)) break;
        to = (request_t){level + 1, 0, {KOOPMAN_LOST_HERE, KOOPMAN_LOST_HERE}};
    }
    int level = s->supervisor.level;
    found = found && level < LAWS;
    recover(s, fault, outside);
    if (s->estimate.known) transfer(&s->estimate, from, model_level(&s->supervisor));
    if (targeted && !CONTROLS_ALL) {
        x_physical(target.x, s->target);
        u_physical(target.u, s->target + NX);
        s->targeted = 1;
    }
    copy(NU, s->command, wanted);
    if (found) {
        if (s->law != level && s->commanded && TRANSFER_TIME > 0.0) {
            for (int i = 0; i < NU; i++) s->offset[i] = s->feed[i] = s->command[i] - u[i];
            s->transferring = 1;
        } else if (s->transferring) {
            fade(s, elapsed);
        }
        s->law = level;
        for (int i = 0; i < NU; i++) wanted[i] = u[i] + (s->transferring ? s->offset[i] : 0.0);
        return;
    }
    if (level == KOOPMAN_SAFE) {
        double share = s->recovering && s->led
            ? smaller(1.0, 1.25 - s->nearest / s->farthest) : 0.0;
        for (int i = 0; i < NU; i++) wanted[i] = SAFE[i] + share * (NOMINAL[i] - SAFE[i]);
        s->transferring = 0;
    }
    if (s->supervisor.resumes < 0) s->law = -1;
}

/* Command, after a measurement that is accepted or has a fault, or without one. */
static void command(koopman_state *s, int fault, double outside, double elapsed, double interval,
                    double counted, koopman_reason *reason)
{
    double wanted[NU], u[NU];
    if (!s->commanded) copy(NU, U_CENTER, s->command);
    *reason = (koopman_reason){fault, fault};
    if (s->manual) {
        copy(NU, s->manual_known ? s->manual_input : s->command, wanted);
        s->law = -1;
        s->transferring = 0;
    } else {
        automatic(s, fault, outside, elapsed, interval, wanted);
        *reason = s->supervisor.reason;
    }
    limit(wanted, s->commanded ? s->command : NULL, counted, u);
    copy(NU, u, s->command);
    s->commanded = 1;
    s->commanded_at = s->now;
    enqueue(s, s->now, u);
}

/* Bring the set-point to the present time; it begins from a state (NX), in its units. */
static void advance(koopman_state *s, const double *x, double seconds)
{
    for (int i = 0; i < NC; i++) {
        int k = CONTROLLED[i];
        double *active = s->setpoint + i, *ramped = s->ramped + i, reach = INFINITY;
        if (!s->active) *active = *ramped = smaller(larger(x[k], X_LOWER[k]), X_UPPER[k]);
        if (isnan(s->requested[i])) s->requested[i] = *active;
        if (!isinf(SETPOINT_RAMP[i])) reach = SETPOINT_RAMP[i] * seconds;
        *ramped = smaller(larger(s->requested[i], *ramped - reach), *ramped + reach);
        *active += FILTER_TIME > 0.0 ? -expm1(-seconds / FILTER_TIME) * (*ramped - *active)
                   : *ramped - *active;
    }
    s->active = 1;
}

/* Take requests of the operator; returns 1 where the set-point is refused. */
static int requests(koopman_state *s, const koopman_inputs *inputs)
{
    int refused = 0;
    if (!inputs->manual != !s->manual) {
        s->manual = !s->manual;
        s->manual_known = s->recovering = 0;
        if (s->estimate.known) transfer(&s->estimate, model_level(&s->supervisor), 0);
        s->supervisor = (koopman_supervisor){-1, -1, NO_REASON, NEVER, NEVER};
    }
    if (s->manual && finite(NU, inputs->manual_input)) {
        copy(NU, inputs->manual_input, s->manual_input);
        s->manual_known = 1;
    }
    for (int i = 0; i < NC; i++) {
        double value = inputs->setpoint[i];
        refused = refused || value < X_LOWER[CONTROLLED[i]] || value > X_UPPER[CONTROLLED[i]];
    }
    for (int i = 0; i < NC && !refused; i++)
        if (!isnan(inputs->setpoint[i])) s->requested[i] = inputs->setpoint[i];
    return refused;
}

void koopman_init(koopman_state *s, const double *applied)
{
    *s = (koopman_state){0};
    s->measured_at = s->commanded_at = s->accepted_at = NEVER;
    s->law = -1;
    s->interval = INFINITY;
    s->supervisor = (koopman_supervisor){-1, -1, NO_REASON, NEVER, NEVER};
    fill(NC, NAN, s->requested);
    if (applied && finite(NU, applied)) {
        within(applied, s->command);
        s->commanded = 1;
        enqueue(s, NEVER, applied);
    }
}

void koopman_step(koopman_state *s, const koopman_inputs *inputs, koopman_outputs *outputs)
{
    koopman_reason reason = s->supervisor.reason;
    if (inputs->elapsed_ns > 0) s->now += inputs->elapsed_ns;
    outputs->setpoint_refused = requests(s, inputs);
    if (inputs->received ? !s->commanded || s->measured_at != s->now : s->commanded) {
        double usual = isinf(s->interval) ? 0.0 : s->interval, gap = since(s, s->measured_at);
        double elapsed = since(s, s->commanded_at), interval = usual, counted = 0.0, state[NX];
        double outside = NAN;
        int fault = KOOPMAN_NO_MEASUREMENT;
        if (!inputs->received) {
            counted = smaller(elapsed, larger(1.0, 2.0 * usual));
        } else {
            interval = smaller(usual, elapsed);
            if (s->measured_at != NEVER && elapsed > 0.0) {
                /* neither a gap nor a burst is the spacing of the samples */
                double seconds = smaller(gap, 2.0 * s->interval);
                s->interval = larger(seconds, 0.5 * usual);
                counted = smaller(seconds, elapsed);
            }
        }
        const koopman_state before = *s;
        if (!inputs->received) {
            predict(s, s->now, elapsed, &s->estimate);
        } else {
            follow(s, inputs->applied);
            fault = observe(s, inputs->measured, elapsed, &outside, state);
            if (fault == KOOPMAN_OK) advance(s, state, counted);
        }
        command(s, fault, outside, elapsed, interval, counted, &reason);
        if (!finite(NU, s->command) || (s->estimate.known && !usable(&s->estimate))) {
            *s = before;
            if (inputs->received) s->measured_at = s->now;
            s->law = -1;
            s->transferring = s->recovering = s->targeted = s->estimate.known = 0;
            command(s, KOOPMAN_CALCULATION_FAILED, NAN, elapsed, interval, counted, &reason);
        }
    }
    copy(NU, s->commanded ? s->command : SAFE, outputs->command);
    outputs->level = s->manual ? KOOPMAN_MANUAL : s->commanded ? s->supervisor.level : KOOPMAN_SAFE;
    outputs->status = s->commanded ? reason.status : KOOPMAN_NO_MEASUREMENT;
    outputs->cause = s->commanded ? reason.cause : KOOPMAN_NO_MEASUREMENT;
    fill(NX, NAN, outputs->state);
    if (s->estimate.known) x_physical(s->estimate.x, outputs->state);
    fill(NC, NAN, outputs->setpoint);
    if (s->active) copy(NC, s->setpoint, outputs->setpoint);
}
