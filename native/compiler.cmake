# Turns C++ on, or stops with what to install. CMake's own complaint, which `project(... CXX)` gives, does not say that.
include(CheckLanguage)

# Stops. What was found is forgotten, so that the next run in the same build folder looks afresh.
function(refuse_compiler found)
  unset(CMAKE_CXX_COMPILER CACHE)
  file(REMOVE_RECURSE "${CMAKE_BINARY_DIR}/CMakeFiles/${CMAKE_VERSION}")
  message(FATAL_ERROR "holosplat's kernels need a C++ compiler: GCC 9 or newer, or clang 11 or newer. ${found}

  Install one, and then holosplat again:
    Debian, Ubuntu   sudo apt install g++
    Fedora           sudo dnf install gcc-c++
    macOS            xcode-select --install
    conda            conda install -c conda-forge cxx-compiler
    Windows          use WSL, as Debian or Ubuntu; or, never tried, LLVM and Visual Studio's build tools, with the
                     environment variables CXX=clang++ and CMAKE_GENERATOR=Ninja (MSVC and MinGW's GCC will not do)
  If one is installed, name it:
    CXX=clang++ pip install .
  Or install holosplat without its kernels, on purpose. What has a backend='reference' (plain torch, slow) then works
  when that is asked for by name, and the rest says that the kernels are missing:
    pip install . -C cmake.define.HOLOSPLAT_KERNELS=OFF")
endfunction()

if(IS_ABSOLUTE "${CMAKE_CXX_COMPILER}" AND NOT EXISTS "${CMAKE_CXX_COMPILER}")
  refuse_compiler("The one that was used before, ${CMAKE_CXX_COMPILER}, is gone.")
endif()
check_language(CXX)
if(NOT CMAKE_CXX_COMPILER AND DEFINED ENV{CXX})
  refuse_compiler("The one asked for, CXX=$ENV{CXX}, is missing or does not work.")
elseif(NOT CMAKE_CXX_COMPILER)
  refuse_compiler("None that works was found.")
endif()
enable_language(CXX)

# The kernels use the vector extensions of GCC and clang, in the form these versions have. GCC on Windows keeps 32-byte
# vectors on a stack aligned to 16 (GCC bug 54412); clang-cl would need Microsoft's spelling of every option.
set(FOUND "${CMAKE_CXX_COMPILER_ID} ${CMAKE_CXX_COMPILER_VERSION} (${CMAKE_CXX_COMPILER})")
if(NOT CMAKE_CXX_COMPILER_ID MATCHES "^(GNU|Clang|AppleClang)$"
   OR (CMAKE_CXX_COMPILER_ID STREQUAL "GNU" AND (WIN32 OR CMAKE_CXX_COMPILER_VERSION VERSION_LESS 9))
   OR (CMAKE_CXX_COMPILER_ID STREQUAL "Clang" AND CMAKE_CXX_COMPILER_VERSION VERSION_LESS 11)
   OR CMAKE_CXX_COMPILER_FRONTEND_VARIANT STREQUAL "MSVC")
  refuse_compiler("The one found will not do: ${FOUND}.")
endif()
