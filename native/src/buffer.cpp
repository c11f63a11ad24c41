#include "buffer.h"

#include <cstdlib>
#include <new>

#if defined(__linux__)
#include <sys/mman.h>
#endif
#if defined(_WIN32)
#include <malloc.h>
#endif

namespace tgb {

void release(void* memory) {
#if defined(_WIN32)
  _aligned_free(memory);
#else
  free(memory);
#endif
}

void* reallocate(void* memory, size_t count, size_t item_size, size_t& capacity) {
  release(memory);
  capacity = 0;
  const size_t room = count + count / 4 + 1024, raw = room * item_size;
  const size_t huge = size_t{2} << 20, alignment = raw >= huge / 2 ? huge : 64;
  const size_t bytes = (raw + alignment - 1) / alignment * alignment;
#if defined(_WIN32)
  void* fresh = _aligned_malloc(bytes, alignment);
#else
  void* fresh = aligned_alloc(alignment, bytes);
#endif
  if (fresh == nullptr) throw std::bad_alloc();
#if defined(__linux__)
  if (alignment == huge) madvise(fresh, bytes, MADV_HUGEPAGE);
#endif
  capacity = room;
  return fresh;
}

}  // namespace tgb
