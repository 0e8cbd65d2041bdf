/* A gate before the controller: measurements that their own past excludes become NaN, which is missing, per mode and sensor.

   Each mode is predicted from its last samples by an autoregression; what is further than WFSOBS_LEVEL running deviations off, more
   where outliers are rare, is an outlier. Five in a row are a new level, or a vibration that appears, and pass. One wfsobs_gate per sensor; C99, no library. Every
   WFSOBS_BLOCK calls the autoregression is fitted anew, which takes the longest: measure that one. */
#ifndef WFSOBS_GATE_H
#define WFSOBS_GATE_H

#include "wfsobs_controller.h"

#define WFSOBS_ORDER @ORDER@
#define WFSOBS_BLOCK @BLOCK@
#define WFSOBS_LEVEL @LEVEL@

/* The state of one mode, and of a gate; all zero is before the first call. */
struct wfsobs_gate_mode {
    unsigned long outliers, counted, rows; /* so far, and before this block; samples fitted to until the first fit, then all */
    int is_known, is_fitted, open, gap, settling, usual[WFSOBS_BLOCK];
    double part, level, offset, deviation, lasting, weights[WFSOBS_ORDER], errors[WFSOBS_BLOCK];
    double past[WFSOBS_ORDER + WFSOBS_BLOCK], normal[(WFSOBS_ORDER + 1) * (WFSOBS_ORDER + 1)];
};

typedef struct {
    unsigned long call;
    struct wfsobs_gate_mode modes[WFSOBS_MODES];
    double factor[WFSOBS_ORDER * WFSOBS_ORDER], sorted[WFSOBS_BLOCK]; /* what a call needs for itself */
} wfsobs_gate;

/* Set outliers of z, of every mode, to NaN. */
void wfsobs_gate_check(wfsobs_gate *gate, wfsobs_real *z);

#endif
