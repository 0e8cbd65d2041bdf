#include "wfsobs_controller.h"

typedef wfsobs_real real;
typedef wfsobs_controller state;

/* e = v - C x, w = x + L e, x <- A w; A by its non-zero elements, C and L of the LGS (0) and of the NGS (1). */
struct step {
    const real *a;
    const int *columns, *starts;
    const real *c0, *l0, *c1, *l1;
};

struct filter {
    int n, count, first; /* states, steps, whether the first step is not repeated */
    const struct step *steps;
    int x; /* where its state begins in that of the controller */
};

/* A step of a Kalman filter near a gap: A and Q by their non-zero elements, C, the variances of the noise, the steady covariance. */
struct gap_step {
    const double *a;
    const int *a_columns, *a_starts;
    const double *q;
    const int *q_columns, *q_starts;
    const double *c, *r, *steady;
};

/* Near a gap the covariance p goes along, until all is measured and the sum of weights (p - steady) is at most most. */
struct gaps {
    int count, sensors; /* steps that repeat, 0 where missing measurements are bridged */
    const struct gap_step *steps;
    const double *weights;
    double most;
    int p; /* where its covariance begins in the state of the controller */
};

struct mode {
    struct filter law, lgs, ngs; /* the controller, and what predicts missing measurements: n = 0 where the last is held */
    struct gaps gaps;
    const real *row;
};

@TABLES@

static const struct mode modes[WFSOBS_MODES] = {
    @FILTERS@
};

static real dot(const real *a, const real *b, int n)
{
    real sum = 0;
    for (int i = 0; i < n; i++) sum += a[i] * b[i];
    return sum;
}

static int is_missing(real v) { return v != v; }

/* From the state after the measurement, w, to the next step. */
static void predict(state *c, const struct filter *f, const struct step *s)
{
    for (int i = 0; i < f->n; i++) {
        real sum = 0;
        for (int j = s->starts[i]; j < s->starts[i + 1]; j++) sum += s->a[j] * c->w[s->columns[j]];
        c->x[f->x + i] = sum;
    }
}

/* One step of a filter with its innovations; w holds the state after the measurement. */
static void move(state *c, const struct filter *f, const struct step *s, real e0, real e1)
{
    for (int i = 0; i < f->n; i++) c->w[i] = c->x[f->x + i] + s->l0[i] * e0;
    if (s->l1)
        for (int i = 0; i < f->n; i++) c->w[i] += s->l1[i] * e1;
    predict(c, f, s);
}

static const struct step *at(const struct filter *f, unsigned long call)
{
    unsigned long repeat = (unsigned long)(f->count - f->first);
    if (f->first && call == 0) return f->steps;
    return f->steps + f->first + (call - (unsigned long)f->first) % repeat;
}

/* Return a measurement with what is missing predicted, and tell its filter. */
static real complete(state *c, const struct filter *f, real v, real *last)
{
    if (f->n == 0) {
        if (!is_missing(v)) *last = v;
        return *last;
    }
    {
        real e, expected = dot(f->steps->c0, c->x + f->x, f->n);
        if (is_missing(v)) v = expected;
        e = v - expected;
        move(c, f, f->steps, e, 0);
    }
    return v;
}

/* p <- A p A' + Q of a step, p from `from`. */
static void grow(const struct gap_step *s, const double *from, double *p, double *product, int n)
{
    for (int i = 0; i < n; i++)
        for (int k = 0; k < n; k++) {
            double sum = 0;
            for (int j = s->a_starts[i]; j < s->a_starts[i + 1]; j++) sum += s->a[j] * from[s->a_columns[j] * n + k];
            product[i * n + k] = sum;
        }
    for (int i = 0; i < n; i++)
        for (int k = 0; k < n; k++) {
            double sum = 0;
            for (int j = s->a_starts[k]; j < s->a_starts[k + 1]; j++) sum += s->a[j] * product[i * n + s->a_columns[j]];
            p[i * n + k] = sum;
        }
    for (int i = 0; i < n; i++)
        for (int j = s->q_starts[i]; j < s->q_starts[i + 1]; j++) p[i * n + s->q_columns[j]] += s->q[j];
}

/* Measure v with this row and a noise of variance r: p and w after it. */
static void measure(const double *row, double r, real v, real *w, double *p, double *ahead, int n)
{
    double variance = r, e = v;
    for (int i = 0; i < n; i++) {
        ahead[i] = 0;
        for (int k = 0; k < n; k++) ahead[i] += p[i * n + k] * row[k];
        variance += row[i] * ahead[i];
        e -= row[i] * w[i];
    }
    for (int i = 0; i < n; i++) {
        w[i] += (real)(ahead[i] / variance * e);
        for (int k = 0; k < n; k++) p[i * n + k] -= ahead[i] / variance * ahead[k];
    }
}

/* Return 0 where a mode is in its steady state and nothing is missing, else take its step and return 1. */
static int near_gap(state *c, int mode, const struct step *s, const real *v, int due)
{
    const struct mode *m = modes + mode;
    const struct gaps *g = &m->gaps;
    const int n = m->law.n, first = m->law.first && c->call == 0;
    const int seen = g->sensors > 1 && due ? 2 : 1;
    const unsigned long count = (unsigned long)g->count;
    const unsigned long j = (c->call + count - (unsigned long)m->law.first) % count;
    const struct gap_step *now = g->steps + j, *before = g->steps + (j + count - 1) % count;
    double above = 0, *p = c->p + g->p;
    int whole = 1;
    for (int i = 0; i < seen; i++) whole = whole && !is_missing(v[i]);
    if (whole && !c->near[mode]) return 0;
    grow(before, c->near[mode] ? p : before->steady, p, c->product, n);
    for (int i = 0; i < n; i++) c->w[i] = c->x[m->law.x + i];
    for (int i = 0; i < seen; i++)
        if (!is_missing(v[i])) measure(now->c + i * n, now->r[i], v[i], c->w, p, c->ahead, n);
    for (int i = 0; i < n; i++)
        for (int k = 0; k < i; k++) p[i * n + k] = p[k * n + i] = 0.5 * (p[i * n + k] + p[k * n + i]);
    for (int i = 0; i < n * n; i++) above += g->weights[i] * (p[i] - now->steady[i]);
    c->near[mode] = first || !whole || above > g->most;
    predict(c, &m->law, s);
    return 1;
}

void wfsobs_step(wfsobs_controller *c, const wfsobs_real *z, const wfsobs_real *ngs, wfsobs_real *u)
{
    int due = WFSOBS_RATIO > 0 && c->call > 0 && c->call % (WFSOBS_RATIO > 0 ? WFSOBS_RATIO : 1) == 0;
    for (int i = 0; i < WFSOBS_MODES; i++) {
        const struct mode *m = modes + i;
        const struct filter *f = &m->law;
        const struct step *s = at(f, c->call);
        volatile real none = 0;
        real v[2] = {z[i], ngs ? ngs[i] : none / none};
        if (!m->gaps.count || !near_gap(c, i, s, v, due)) {
            real e0 = complete(c, &m->lgs, v[0], c->last_z + i) - dot(s->c0, c->x + f->x, f->n), e1 = 0;
            if (due && s->c1) e1 = complete(c, &m->ngs, v[1], c->last_ngs + i) - dot(s->c1, c->x + f->x, f->n);
            move(c, f, s, e0, e1);
        }
        u[i] = dot(m->row, c->w, f->n);
    }
    c->call++;
}

void wfsobs_reset(wfsobs_controller *c)
{
    for (int i = 0; i < (int)(sizeof c->x / sizeof *c->x); i++) c->x[i] = 0;
    for (int i = 0; i < WFSOBS_MODES; i++) {
        c->near[i] = 0;
        c->last_z[i] = c->last_ngs[i] = 0;
    }
    c->call = 0;
}
