/*
@CONVENTIONS@

   C99, static memory, no library: one controller per program. Compile with -DWFSOBS_REAL=float for single precision, and
   without -ffast-math, which has no NaN.
*/
#ifndef WFSOBS_CONTROLLER_H
#define WFSOBS_CONTROLLER_H

#ifndef WFSOBS_REAL
#define WFSOBS_REAL double
#endif

#define WFSOBS_MODES @MODES@
#define WFSOBS_RATIO @RATIO@ /* calls per NGS frame, 0 without */

typedef WFSOBS_REAL wfsobs_real;

/* Set the state back to before call 0. */
void wfsobs_reset(void);

/* One call: z and ngs of every mode in, u of every mode out. ngs may be a null pointer: a frame that is due is then missing. */
void wfsobs_step(const wfsobs_real *z, const wfsobs_real *ngs, wfsobs_real *u);

#endif
