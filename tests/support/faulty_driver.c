/* Stands in front of an OpenCL loader (LD_PRELOAD) and makes one device's driver faulty, as some are:
 *   FAULT=abort    its compiler ends the process        FAULT=hang    its compiler never ends
 *   FAULT=wrong    its code computes another number     FAULT=list    asking for its devices ends the process
 * FAULT_IN   only for devices whose driver version has these words in it (all by default)
 * FAULT_AT   only for programs built with these words among the options (all by default)
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <link.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

typedef int cl_int;
typedef unsigned int cl_uint;
#define DRIVER_VERSION 0x102D
#define PROGRAM_DEVICES 0x1163

static int is_loader(struct dl_phdr_info *info, size_t size, void *path)
{
    if (!strstr(info->dlpi_name, "libOpenCL"))
        return 0;
    strncpy(path, info->dlpi_name, 1023);
    return 1;
}

/* The function behind ours, in the loader that pyopencl has brought along or found. */
static void *next(const char *name)
{
    static char path[1024];
    if (!path[0])
        dl_iterate_phdr(is_loader, path);
    return dlsym(dlopen(path, RTLD_LAZY | RTLD_NOLOAD), name);
}

static int fault_is(const char *name)
{
    const char *fault = getenv("FAULT");
    return fault && strcmp(fault, name) == 0;
}

static int meant(void *device, const char *options)
{
    const char *in = getenv("FAULT_IN"), *at = getenv("FAULT_AT");
    char driver[256] = "";
    cl_int (*info)(void *, cl_uint, size_t, void *, size_t *) = next("clGetDeviceInfo");
    info(device, DRIVER_VERSION, sizeof(driver) - 1, driver, NULL);
    return (!in || strstr(driver, in)) && (!at || (options && strstr(options, at)));
}

cl_int clBuildProgram(void *program, cl_uint count, void *const *devices, const char *options, void *done, void *data)
{
    cl_int (*real)(void *, cl_uint, void *const *, const char *, void *, void *) = next("clBuildProgram");
    cl_int (*info)(void *, cl_uint, size_t, void *, size_t *) = next("clGetProgramInfo");
    void *of_program[16];
    info(program, PROGRAM_DEVICES, sizeof(of_program), of_program, NULL);
    if (meant(of_program[0], options)) {
        if (fault_is("abort")) {
            fprintf(stderr, "LLVM ERROR: Cannot select: fsqrt\n");
            abort();
        }
        if (fault_is("hang"))
            sleep(1000);
        if (fault_is("wrong") && strstr(options, "-DSPAN=")) {      /* the others are those of a good driver */
            char *more = malloc(strlen(options) + 64);
            sprintf(more, "%s -DSPAN=2", options);
            return real(program, count, devices, more, done, data);
        }
    }
    return real(program, count, devices, options, done, data);
}

cl_int clGetDeviceIDs(void *platform, unsigned long type, cl_uint entries, void **devices, cl_uint *found)
{
    cl_int (*real)(void *, unsigned long, cl_uint, void **, cl_uint *) = next("clGetDeviceIDs");
    const cl_int status = real(platform, type, entries, devices, found);
    if (fault_is("list") && status == 0 && entries > 0 && meant(devices[0], NULL))
        abort();
    return status;
}
