#include "wfsobs_controller.h"

typedef wfsobs_real real;

/* e = v - C x, w = x + L e, x <- A w; A by its non-zero elements, C and L of the LGS (0) and of the NGS (1). */
struct step {
    const real *a;
    const int *columns, *starts;
    const real *c0, *l0, *c1, *l1;
};

struct filter {
    int n, count, first; /* states, steps, whether the first step is not repeated */
    const struct step *steps;
    real *x;
};

struct mode {
    struct filter law, lgs, ngs; /* the controller, and what predicts missing measurements: n = 0 where the last is held */
    const real *row;
    int own; /* whether the controller predicts them itself */
};

@TABLES@

static const struct mode modes[WFSOBS_MODES] = {
    @FILTERS@
};

static real last_z[WFSOBS_MODES], last_ngs[WFSOBS_MODES], w[@STATES@];
static unsigned long call;

static real dot(const real *a, const real *b, int n)
{
    real sum = 0;
    for (int i = 0; i < n; i++) sum += a[i] * b[i];
    return sum;
}

static int is_missing(real v) { return v != v; }

/* One step of a filter with its innovations; w holds the state after the measurement. */
static void move(const struct filter *f, const struct step *s, real e0, real e1)
{
    for (int i = 0; i < f->n; i++) w[i] = f->x[i] + s->l0[i] * e0;
    if (s->l1)
        for (int i = 0; i < f->n; i++) w[i] += s->l1[i] * e1;
    for (int i = 0; i < f->n; i++) {
        real sum = 0;
        for (int j = s->starts[i]; j < s->starts[i + 1]; j++) sum += s->a[j] * w[s->columns[j]];
        f->x[i] = sum;
    }
}

static const struct step *at(const struct filter *f)
{
    unsigned long repeat = (unsigned long)(f->count - f->first);
    if (f->first && call == 0) return f->steps;
    return f->steps + f->first + (call - (unsigned long)f->first) % repeat;
}

/* Return a measurement with what is missing predicted, and tell its filter. */
static real complete(const struct filter *f, real v, real *last)
{
    if (f->n == 0) {
        if (!is_missing(v)) *last = v;
        return *last;
    }
    {
        real e, expected = dot(f->steps->c0, f->x, f->n);
        if (is_missing(v)) v = expected;
        e = v - expected;
        move(f, f->steps, e, 0);
    }
    return v;
}

void wfsobs_step(const wfsobs_real *z, const wfsobs_real *ngs, wfsobs_real *u)
{
    int due = WFSOBS_RATIO > 0 && call > 0 && call % (WFSOBS_RATIO > 0 ? WFSOBS_RATIO : 1) == 0;
    for (int i = 0; i < WFSOBS_MODES; i++) {
        const struct mode *m = modes + i;
        const struct filter *f = &m->law;
        const struct step *s = at(f);
        real e0 = 0, e1 = 0;
        if (!m->own)
            e0 = complete(&m->lgs, z[i], last_z + i) - dot(s->c0, f->x, f->n);
        else if (!is_missing(z[i]))
            e0 = z[i] - dot(s->c0, f->x, f->n);
        if (due && s->c1) {
            volatile real none = 0;
            real v = ngs ? ngs[i] : none / none;
            e1 = complete(&m->ngs, v, last_ngs + i) - dot(s->c1, f->x, f->n);
        }
        move(f, s, e0, e1);
        u[i] = dot(m->row, w, f->n);
    }
    call++;
}

static void rest(const struct filter *f)
{
    for (int i = 0; i < f->n; i++) f->x[i] = 0;
}

void wfsobs_reset(void)
{
    for (int i = 0; i < WFSOBS_MODES; i++) {
        rest(&modes[i].law);
        rest(&modes[i].lgs);
        rest(&modes[i].ngs);
        last_z[i] = last_ngs[i] = 0;
    }
    call = 0;
}
