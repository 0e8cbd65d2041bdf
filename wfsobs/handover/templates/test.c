/* Compare with the commands of the run over a record: input.f64 holds z and ngs of every step, output.f64 the commands. And with
   what the gate lets through: gate.f64 holds z of every step before and after it. */
#include <stdio.h>
#include <time.h>

#include "wfsobs_gate.h"

#define MODES WFSOBS_MODES

static double in[2 * MODES], want[MODES];
static wfsobs_controller controller, other; /* the other one takes other measurements meanwhile */

static long run(FILE *input, FILE *output, double *error, double *sum, double *square)
{
    wfsobs_real z[MODES], ngs[MODES], u[MODES];
    long n = 0;
    while (fread(in, sizeof in, 1, input) == 1 && fread(want, sizeof want, 1, output) == 1) {
        for (int i = 0; i < MODES; i++) {
            z[i] = (wfsobs_real)in[i];
            ngs[i] = (wfsobs_real)in[MODES + i];
        }
        wfsobs_step(&other, ngs, z, u);
        wfsobs_step(&controller, z, ngs, u);
        for (int i = 0; i < MODES; i++) {
            double d = (double)u[i] - want[i];
            if (d < 0) d = -d;
            if (!(d <= *error)) *error = d; /* NaN as well */
            *sum += want[i];
            *square += want[i] * want[i];
        }
        n++;
    }
    return n;
}

/* Number of measurements of which the gate makes something else than it should; and of outliers. */
static long differ(FILE *file, long *outliers)
{
    static wfsobs_gate gate;
    double row[2 * MODES];
    long wrong = 0;
    while (fread(row, sizeof row, 1, file) == 1) {
        wfsobs_real z[MODES];
        for (int i = 0; i < MODES; i++) z[i] = (wfsobs_real)row[i];
        wfsobs_gate_check(&gate, z);
        for (int i = 0; i < MODES; i++) wrong += (z[i] == z[i]) != (row[MODES + i] == row[MODES + i]);
    }
    for (int i = 0; i < MODES; i++) *outliers += (long)gate.modes[i].outliers;
    return wrong;
}

/* Time of a step [us], every so many of which has no measurement; 0: none. */
static double time_of(long steps, long gap)
{
    wfsobs_real z[MODES], u[MODES];
    clock_t start = clock();
    for (long k = 0; k < steps; k++) {
        volatile wfsobs_real none = 0;
        for (int i = 0; i < MODES; i++) z[i] = gap && k % gap == 0 ? none / none : (wfsobs_real)(k % 5) * (wfsobs_real)0.01;
        wfsobs_step(&controller, z, z, u);
    }
    return 1e6 * (double)(clock() - start) / CLOCKS_PER_SEC / (double)steps;
}

int main(void)
{
    double error = 0, sum = 0, square = 0, variance, limit = sizeof(wfsobs_real) == 8 ? 1e-12 : 1e-5;
    FILE *input = fopen("input.f64", "rb"), *output = fopen("output.f64", "rb"), *gated = fopen("gate.f64", "rb");
    long n, wrong, outliers = 0;
    int equal;
    if (!input || !output || !gated) return fprintf(stderr, "input.f64, output.f64 or gate.f64 is missing\n"), 2;
    wrong = differ(gated, &outliers);
    fclose(gated);
    if (wrong || !outliers) return printf("the gate differs in %ld measurements, of %ld outliers\n", wrong, outliers), 1;
    wfsobs_reset(&controller);
    n = run(input, output, &error, &sum, &square);
    fclose(input);
    fclose(output);
    if (n < 1) return fprintf(stderr, "no test vectors\n"), 2;
    variance = square / (double)(n * MODES) - (sum / (double)(n * MODES)) * (sum / (double)(n * MODES));
    equal = error * error <= limit * limit * variance; /* error / std <= limit without a square root */
    printf("%d bytes a number, %ld steps: ", (int)sizeof(wfsobs_real), n);
    if (equal) printf("%.3f us a step, %.3f us where one in seven is missing, ", time_of(200000, 0), time_of(20000, 7));
    printf("(largest error / std)^2 = %.2g, allowed %.0g: %s\n", error * error / variance, limit * limit, equal ? "equal" : "differs");
    return !equal;
}
