// TGB_API marks the functions of the plain C interface; everything else in the library stays hidden.
#pragma once
#if defined(_WIN32)
#define TGB_API extern "C" __declspec(dllexport)
#else
#define TGB_API extern "C" __attribute__((visibility("default")))
#endif
