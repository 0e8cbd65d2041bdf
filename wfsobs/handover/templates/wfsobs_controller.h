/*
@CONVENTIONS@

   C99, no library, no memory but the caller's: each wfsobs_controller is a controller by itself, and several may run at once.
   Compile with -DWFSOBS_REAL=float for single precision, and without -ffast-math, which has no NaN.
*/
#ifndef WFSOBS_CONTROLLER_H
#define WFSOBS_CONTROLLER_H

#ifndef WFSOBS_REAL
#define WFSOBS_REAL double
#endif

#define WFSOBS_MODES @MODES@
#define WFSOBS_RATIO @RATIO@ /* calls per NGS frame, 0 without */

typedef WFSOBS_REAL wfsobs_real;

/* The state of a controller; its members are not the caller's. All zero is before call 0, as static memory is. */
typedef struct {
    unsigned long call;
    wfsobs_real x[@X@], last_z[WFSOBS_MODES], last_ngs[WFSOBS_MODES];
    double p[@P@];
    int near[WFSOBS_MODES];
    wfsobs_real w[@STATES@]; /* from here on what a step needs for itself */
    double ahead[@STATES@], product[@PRODUCT@];
} wfsobs_controller;

/* Set the state to before call 0. */
void wfsobs_reset(wfsobs_controller *controller);

/* One call: z and ngs of every mode in, u of every mode out. ngs may be a null pointer: a frame that is due is then missing. */
void wfsobs_step(wfsobs_controller *controller, const wfsobs_real *z, const wfsobs_real *ngs, wfsobs_real *u);

#endif
