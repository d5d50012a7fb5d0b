# One place for the warnings and sanitizers of every target of ours.
option(RADARSDF_WERROR "Treat warnings as errors (CI)" OFF)
set(RADARSDF_SANITIZE "" CACHE STRING "Sanitizers to build with: address,undefined or thread (tools/test_core.sh, tools/sanitize.sh)")

function(radarsdf_compiler_options target)
  target_compile_features(${target} PUBLIC cxx_std_17)
  if(MSVC)
    target_compile_options(${target} PRIVATE /W4 $<$<BOOL:${RADARSDF_WERROR}>:/WX>)
  else()
    # clang's -Wconversion has -Wsign-conversion in it, gcc's has not: the same warnings of both.
    target_compile_options(${target} PRIVATE -Wall -Wextra -Wconversion -Wno-sign-conversion -Wshadow
                                             $<$<BOOL:${RADARSDF_WERROR}>:-Werror>)
  endif()
  if(RADARSDF_SANITIZE)
    # Undefined behaviour ends the program, or a test would pass over it; debug information names the line.
    target_compile_options(${target} PRIVATE -fsanitize=${RADARSDF_SANITIZE} -fno-sanitize-recover=all
                                             -fno-omit-frame-pointer -g1)
    target_link_options(${target} PUBLIC -fsanitize=${RADARSDF_SANITIZE})
  endif()
endfunction()
