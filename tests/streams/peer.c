/* The other side of a stream, in C: its structure is laid out by the compiler, its semaphores are the C library's.
 *
 * peer loop IN OUT FRAMES N VALUES RESULT MAXWAIT_US NBBLOCK
 *     Sends FRAMES frames of N float32 from the file VALUES on the stream IN, as a modal filter does: after each it waits until
 *     the counter of the stream OUT has risen by NBBLOCK, at most MAXWAIT_US, and then writes what OUT holds to the file RESULT.
 * peer hammer PATH N
 *     Writes frames of N equal float64, one right after the other, until it is killed.
 */
#include <fcntl.h>
#include <semaphore.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <time.h>
#include <unistd.h>

typedef struct {
    char version[32], name[80];
    uint8_t naxis;
    uint32_t size[3];
    uint64_t nelement;
    uint8_t datatype;
    uint64_t imagetype;
    struct timespec creationtime, lastaccesstime, atime, writetime;
    pid_t creatorPID, ownerPID;
    uint8_t shared;
    ino_t inode;
    int8_t location;
    uint8_t status;
    uint64_t flag;
    uint8_t logflag;
    uint16_t sem, NBproctrace;
    uint64_t : 0;
    uint64_t cnt0, cnt1, cnt2;
    uint8_t write;
    uint16_t NBkw;
    uint32_t CBsize, CBindex;
    uint64_t CBcycle, imdatamemsize;
    char cudaMemHandle[64];
} Header;

enum { SEMAPHORES = 10, KEYWORD = 128 };

typedef struct {
    volatile Header *header;
    void *data;
    sem_t *semaphores;
} Stream;

static Stream at(void *map) {
    Stream s = {map, (char *)map + sizeof(Header), NULL};
    Header *h = map;
    s.semaphores = (sem_t *)((char *)s.data + h->imdatamemsize + (size_t)KEYWORD * h->NBkw);
    return s;
}

static Stream make(const char *path, uint32_t n, int is_double, uint16_t keywords) {
    size_t data = ((size_t)n * (is_double ? 8 : 4) + 7) / 8 * 8;
    size_t size = sizeof(Header) + data + (size_t)KEYWORD * keywords + SEMAPHORES * sizeof(sem_t);
    char unfinished[512];
    snprintf(unfinished, sizeof unfinished, "%s.new", path);
    int file = open(unfinished, O_RDWR | O_CREAT | O_TRUNC, 0644);
    if (file < 0 || ftruncate(file, (off_t)size)) exit(3);
    void *map = mmap(NULL, size, PROT_READ | PROT_WRITE, MAP_SHARED, file, 0);
    Header *h = map;
    strcpy(h->version, "2.00");
    strcpy(h->name, "peer");
    h->naxis = 2, h->size[0] = n, h->size[1] = 1, h->nelement = n, h->datatype = is_double ? 10 : 9;
    h->shared = 1, h->location = -1, h->sem = SEMAPHORES, h->NBkw = keywords, h->imdatamemsize = data;
    Stream s = at(map);
    for (int i = 0; i < SEMAPHORES; i++) sem_init(&s.semaphores[i], 1, 0);
    if (rename(unfinished, path)) exit(3);
    return s;
}

static Stream find(const char *path) {
    struct stat state;
    for (int tries = 0; stat(path, &state); tries++) {
        if (tries > 60000) exit(4);
        usleep(1000);
    }
    int file = open(path, O_RDWR);
    void *map = mmap(NULL, (size_t)state.st_size, PROT_READ | PROT_WRITE, MAP_SHARED, file, 0);
    if (strcmp(((Header *)map)->version, "2.00")) exit(5);
    return at(map);
}

static void publish(Stream s) {
    s.header->cnt0++;
    s.header->write = 0;
    for (int i = 0; i < s.header->sem; i++) sem_post(&s.semaphores[i]);
}

static int reached(Stream s, uint64_t count, long microseconds) {
    struct timespec until;
    clock_gettime(CLOCK_REALTIME, &until);
    until.tv_sec += microseconds / 1000000, until.tv_nsec += microseconds % 1000000 * 1000;
    if (until.tv_nsec >= 1000000000) until.tv_sec++, until.tv_nsec -= 1000000000;
    while (s.header->cnt0 < count)
        if (sem_timedwait(&s.semaphores[0], &until)) return s.header->cnt0 >= count;
    return 1;
}

static int loop(char **a) {
    long frames = atol(a[2]), n = atol(a[3]), wait = atol(a[6]), blocks = atol(a[7]), missed = 0;
    float *values = malloc((size_t)n * 4);
    FILE *in = fopen(a[4], "rb"), *result = fopen(a[5], "wb");
    Stream ol = make(a[0], (uint32_t)n, 0, 3), pf = find(a[1]);
    for (long k = 0; k < frames; k++) {
        if (fread(values, 4, (size_t)n, in) != (size_t)n) return 6;
        uint64_t before = pf.header->cnt0;
        ol.header->write = 1;
        memcpy(ol.data, values, (size_t)n * 4);
        publish(ol);
        missed += !reached(pf, before + (uint64_t)blocks, wait);
        fwrite(pf.data, 4, (size_t)n, result);
    }
    fclose(result);
    printf("%ld\n", missed);
    return 0;
}

static void hammer(char **a) {
    long n = atol(a[1]);
    Stream s = make(a[0], (uint32_t)n, 1, 0);
    double *data = s.data;
    for (long k = 1;; k++) {
        s.header->write = 1;
        __sync_synchronize();
        for (long i = 0; i < n; i++) data[i] = (double)k;
        __sync_synchronize();
        publish(s);
        usleep(20);
    }
}

int main(int count, char **a) {
    if (count == 10 && !strcmp(a[1], "loop")) return loop(a + 2);
    if (count == 4 && !strcmp(a[1], "hammer")) hammer(a + 2);
    return 2;
}
