# Wheels for manylinux_2_28 from a machine with a newer glibc and compiler. The containers of cibuildwheel need none of it.
option(RADARSDF_GLIBC_2_28 "Link the extension so that it runs where glibc is 2.28 or newer (x86-64)" OFF)

function(radarsdf_link_for_older_glibc target)
  if(RADARSDF_GLIBC_2_28)
    if(NOT (CMAKE_SYSTEM_NAME STREQUAL "Linux" AND CMAKE_SYSTEM_PROCESSOR STREQUAL "x86_64"))
      message(FATAL_ERROR "RADARSDF_GLIBC_2_28 is for Linux on x86-64")
    endif()
    target_sources(${target} PRIVATE ${PROJECT_SOURCE_DIR}/cmake/glibc_2_28.cpp)
    target_link_options(${target} PRIVATE -static-libstdc++ -Wl,--exclude-libs,ALL,--gc-sections
                                          -Wl,--wrap=pow,--wrap=exp,--wrap=pthread_once,--wrap=__pthread_key_create
                                          -Wl,--wrap=pthread_create,--wrap=pthread_join)
  endif()
endfunction()
