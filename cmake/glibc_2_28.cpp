// What a newer glibc adds under old names: with these the extension asks for nothing newer than glibc 2.28. The linker
// sends calls of `pow` to `__wrap_pow`, which calls the version that every glibc has; the bits of the results are
// equal.
#include <pthread.h>

extern "C" {

double pow_of_all_glibc(double, double);
double exp_of_all_glibc(double);
int pthread_once_of_all_glibc(pthread_once_t*, void (*)());
int key_create_of_all_glibc(pthread_key_t*, void (*)(void*));
int create_of_all_glibc(pthread_t*, const pthread_attr_t*, void* (*)(void*), void*);
int join_of_all_glibc(pthread_t, void**);
__asm__(".symver pow_of_all_glibc, pow@GLIBC_2.2.5");
__asm__(".symver exp_of_all_glibc, exp@GLIBC_2.2.5");
__asm__(".symver pthread_once_of_all_glibc, pthread_once@GLIBC_2.2.5");
__asm__(".symver key_create_of_all_glibc, __pthread_key_create@GLIBC_2.2.5");
__asm__(".symver create_of_all_glibc, pthread_create@GLIBC_2.2.5");
__asm__(".symver join_of_all_glibc, pthread_join@GLIBC_2.2.5");

double __wrap_pow(double base, double exponent) { return pow_of_all_glibc(base, exponent); }
double __wrap_exp(double exponent) { return exp_of_all_glibc(exponent); }
int __wrap_pthread_once(pthread_once_t* once, void (*function)()) { return pthread_once_of_all_glibc(once, function); }
int __wrap___pthread_key_create(pthread_key_t* key, void (*end)(void*)) { return key_create_of_all_glibc(key, end); }
int __wrap_pthread_create(pthread_t* thread, const pthread_attr_t* attributes, void* (*function)(void*), void* data) {
  return create_of_all_glibc(thread, attributes, function, data);
}
int __wrap_pthread_join(pthread_t thread, void** result) { return join_of_all_glibc(thread, result); }

// glibc 2.32 sets it where a process has one thread, so that reference counts need no atomic operations.
__attribute__((visibility("hidden"))) char __libc_single_threaded = 0;
}
