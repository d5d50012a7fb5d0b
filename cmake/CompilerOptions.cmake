# One place for the warnings of every target of ours.
option(RADARSDF_WERROR "Treat warnings as errors (CI)" OFF)

function(radarsdf_compiler_options target)
  target_compile_features(${target} PUBLIC cxx_std_17)
  if(MSVC)
    target_compile_options(${target} PRIVATE /W4 $<$<BOOL:${RADARSDF_WERROR}>:/WX>)
  else()
    target_compile_options(${target} PRIVATE -Wall -Wextra -Wconversion -Wshadow
                                             $<$<BOOL:${RADARSDF_WERROR}>:-Werror>)
  endif()
endfunction()
