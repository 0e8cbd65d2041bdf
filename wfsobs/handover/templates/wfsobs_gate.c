#include "wfsobs_gate.h"

enum { ORDER = WFSOBS_ORDER, BLOCK = WFSOBS_BLOCK, RUN = @RUN@, OPEN = @OPEN@ };
static const double memory = @MEMORY@, forget = @FORGET@, most = @LASTING@, early = @EARLY@, earliest = @EARLIEST@,
                    median_share = @MEDIAN@, ridge = @RIDGE@, first_levels = @FIRST@, pace = @PACE@, usual_part = @USUAL@,
                    least_part = @RAREST@, first_part = @START@;

typedef struct wfsobs_gate_mode mode;

static double size_of(double x) { return x < 0 ? -x : x; }

static double square_root(double x)
{
    double root = x < 1 ? 1 : x, before = 2 * root;
    while (x > 0 && root < before) {
        before = root;
        root = 0.5 * (root + x / root);
    }
    return x > 0 ? before : 0;
}

/* Return the median of n numbers, which it sorts. */
static double median_of(double *x, int n)
{
    for (int i = 1; i < n; i++) {
        double one = x[i];
        int j = i;
        for (; j > 0 && x[j - 1] > one; j--) x[j] = x[j - 1];
        x[j] = one;
    }
    return n % 2 ? x[n / 2] : 0.5 * (x[n / 2 - 1] + x[n / 2]);
}

/* Take the median of the errors of this block into the deviation; the first one keeps what is far out of the fit. */
static void fit_deviation(wfsobs_gate *g, mode *m)
{
    int n = 0;
    double median;
    for (int i = 0; i < BLOCK; i++)
        if (m->usual[i]) g->sorted[n++] = size_of(m->errors[i]);
    if (n <= BLOCK / 4) return;
    median = median_of(g->sorted, n) / median_share;
    if (m->is_known) {
        if (m->deviation > 0) m->deviation *= square_root(square_root(square_root(median / m->deviation))); /* pace: 1/8 */
        return;
    }
    m->deviation = median;
    m->is_known = 1;
    for (int i = 0; i < BLOCK; i++)
        if (size_of(m->errors[i]) > first_levels * WFSOBS_LEVEL * median) {
            m->usual[i] = 0;
            m->past[ORDER + i] = m->past[ORDER + i - 1];
        }
}

/* Take the outliers of this block into the level, which is higher where they are rare, and after a fit to few blocks. */
static void fit_level(mode *m, double blocks)
{
    double part;
    m->part += pace * ((double)(m->outliers - m->counted) / BLOCK - m->part);
    m->counted = m->outliers;
    part = m->part > usual_part ? usual_part : m->part < least_part ? least_part : m->part;
    m->level = WFSOBS_LEVEL * square_root(square_root(square_root(square_root(usual_part / part))));
    m->level *= 1 + (blocks > 1 ? early / (blocks * blocks) : earliest);
}

/* Add a sample and those before it to the normal equations. */
static void add_row(mode *m, int k)
{
    const double *row = m->past + k;
    for (int i = 0; m->usual[k] && i <= ORDER; i++)
        for (int j = 0; j <= i; j++) m->normal[i * (ORDER + 1) + j] += row[i] * row[j];
}

/* Least squares with a memory, by a Cholesky factor of the normal equations. */
static void fit_weights(wfsobs_gate *g, mode *m)
{
    const int n = ORDER + 1;
    double trace = 0, *L = g->factor, *w = m->weights;
    for (int i = 0; i < ORDER; i++) trace += m->normal[i * n + i];
    if (!(trace > 0)) return;
    for (int i = 0; i < ORDER; i++)
        for (int j = 0; j <= i; j++) {
            double sum = m->normal[i * n + j] + (i == j ? ridge * trace : 0);
            for (int k = 0; k < j; k++) sum -= L[i * ORDER + k] * L[j * ORDER + k];
            if (i == j && !(sum > 0)) return; /* no more of it than rounding */
            L[i * ORDER + j] = i == j ? square_root(sum) : sum / L[j * ORDER + j];
        }
    for (int i = 0; i < ORDER; i++) {
        w[i] = m->normal[ORDER * n + i];
        for (int k = 0; k < i; k++) w[i] -= L[i * ORDER + k] * w[k];
        w[i] /= L[i * ORDER + i];
    }
    for (int i = ORDER - 1; i >= 0; i--) {
        for (int k = i + 1; k < ORDER; k++) w[i] -= L[k * ORDER + i] * w[k];
        w[i] /= L[i * ORDER + i];
    }
    m->is_fitted = 1;
}

/* Open the gate where outliers last; errors of one sign are a jump, which the past has had from then on. */
static void count_outlier(wfsobs_gate *g, mode *m, int is_outlier, int k)
{
    m->lasting = (1 - forget) * m->lasting + is_outlier;
    m->outliers += (unsigned long)is_outlier;
    if (m->lasting > most) {
        int first = k + 1 < RUN ? 0 : k + 1 - RUN, above = 1, below = 1;
        for (int i = first; i <= k; i++) {
            above = above && m->errors[i] > 0;
            below = below && m->errors[i] < 0;
            g->sorted[i - first] = m->errors[i];
        }
        if (above || below) m->offset += median_of(g->sorted, k + 1 - first);
        m->open = OPEN;
        m->lasting = 0;
        m->deviation *= 2;
    } else if (m->open > 0) {
        m->open--;
    }
}

/* Blocks that the weights are fitted to, rounded: what is missing before the first fit is none of them. */
static unsigned long blocks_of(const mode *m) { return (m->rows + BLOCK / 2) / BLOCK; }

/* Fit the deviation, the level and the weights after the last sample of a block. */
static void fit(wfsobs_gate *g, mode *m)
{
    const int was_known = m->is_known, was_fitted = blocks_of(m) > 1;
    fit_deviation(g, m);
    for (int k = 0; !was_known && k < BLOCK; k++) add_row(m, k); /* what is far out is known now */
    for (int k = 0; k < BLOCK; k++) m->rows += was_fitted || m->usual[k];
    fit_level(m, (double)blocks_of(m));
    if (blocks_of(m) > 1) fit_weights(g, m); /* fewer have too few samples for them */
    for (int i = 0; i < ORDER; i++) m->past[i] = m->past[BLOCK + i];
}

/* Spread the error of the prediction after a gap over the predictions that stand for what is missing: no step is left. */
static void bridge(mode *m, double error, int k)
{
    for (int j = ORDER + k, left = m->gap; j > 0 && left > 0; left--) m->past[--j] += error * left / (m->gap + 1);
}

void wfsobs_gate_check(wfsobs_gate *g, wfsobs_real *z)
{
    const int k = (int)(g->call % BLOCK);
    for (int i = 0; i < WFSOBS_MODES; i++) {
        mode *m = g->modes + i;
        double limit, error, expected = 0;
        int is_there = z[i] == z[i], is_outlier;
        if (g->call == 0) m->offset = is_there ? (double)z[i] : 0, m->part = first_part;
        if (m->is_fitted)
            for (int j = 0; j < ORDER; j++) expected += m->weights[j] * m->past[k + j];
        else
            expected = m->past[k + ORDER - 1];
        limit = m->level * m->deviation;
        error = is_there ? (double)z[i] - m->offset - expected : 0;
        if (m->settling > 0) m->settling--;
        if (is_there && m->gap >= RUN) { /* the prediction is worth little */
            m->open = m->settling = OPEN;
            bridge(m, error, k);
        }
        m->gap = is_there ? 0 : m->gap + 1;
        is_outlier = is_there && m->is_known && !m->open && size_of(error) > limit;
        m->errors[k] = error;
        m->usual[k] = is_there && !is_outlier && !m->settling;
        m->past[ORDER + k] = expected + (is_outlier ? 0 : error);
        if (is_outlier) {
            volatile wfsobs_real none = 0;
            z[i] = none / none;
        }
        count_outlier(g, m, is_outlier, k);
        for (int j = 0; k == 0 && j < (ORDER + 1) * (ORDER + 1); j++) m->normal[j] *= memory;
        if (m->is_known) add_row(m, k);
        if (k == BLOCK - 1) fit(g, m);
    }
    g->call++;
}
